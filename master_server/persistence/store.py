# SPDX-License-Identifier: Apache-2.0
"""The state that outlives the master, in one SQLite file: units with their poses, settings, versions and the cell.

Every change is written here first and applied in memory afterwards. So an acknowledged change is on the disk, and a
change that could not be written did not happen. The event loop itself writes, not a thread: no other change can come
between check and commit, and memory never has to be rolled back. A change is a few kilobytes and one fsync, which take
some milliseconds. An update writes nothing. Only meshes are long: a thread may call `add_meshes` before, and
`save_cell` then writes only the document.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import sqlite3
import threading
import weakref
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from shared.camera import Intrinsics
from shared.cell import Cell
from shared.configuration import sentence
from shared.errors import CellError, ConfigError, Refusal
from shared.files import sync_folder
from shared.messages import Counter, Matrix, Message, PoseOrigin, PoseQuality, Versions
from shared.settings import Settings

logger = logging.getLogger(__name__)

FILE_NAME = "master.db"

APPLICATION_ID = 0x43574D53
"""Stored in the file's header; distinguishes our file from another program's database."""

SCHEMA_VERSION = 3

UPGRADES = {
    1: "ALTER TABLE units ADD COLUMN pose_quality TEXT NOT NULL DEFAULT '{}'",
    2: "ALTER TABLE units ADD COLUMN intrinsics TEXT",
}
"""The statement that turns a store of the given version into one of the next version."""

LOCK_TIMEOUT_S = 3.0
"""A master that is shutting down has closed its file by then."""

TRY_EVERY_S = 1.0
"""Between attempts to write after a change could not be stored."""

LOG_BYTES = 2**22
"""Largest size of SQLite's log once its content is in the file."""

SCHEMA = f"""
CREATE TABLE units (
    id INTEGER PRIMARY KEY,
    ip TEXT NOT NULL UNIQUE,
    serial TEXT NOT NULL,
    model TEXT NOT NULL,
    software TEXT NOT NULL,
    boot_id TEXT NOT NULL,
    T_world_camera TEXT,
    pose_origin TEXT,
    pose_version INTEGER NOT NULL,
    note TEXT NOT NULL,
    pose_quality TEXT NOT NULL,
    intrinsics TEXT
);
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE meshes (sha256 TEXT PRIMARY KEY, data BLOB NOT NULL);
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {SCHEMA_VERSION};
"""


class UnitRecord(Message):
    """The stored state of a unit. It is immutable: a change makes a new record."""

    id: Counter
    ip: str
    serial: str = ""
    model: str = ""
    software: str = ""
    boot_id: str = ""
    T_world_camera: Matrix | None = None
    pose_origin: PoseOrigin | None = None
    pose_version: Counter = 0
    note: str = ""
    pose_quality: PoseQuality = PoseQuality()
    intrinsics: Intrinsics | None = None

    def with_pose(
        self,
        T_world_camera: Matrix | None,
        origin: PoseOrigin | None,
        note: str = "",
        quality: PoseQuality | None = None,
    ) -> UnitRecord:
        """Return the same unit with another pose of its camera, or without one; `note` gives the reason."""
        return self.model_copy(
            update={
                "T_world_camera": T_world_camera,
                "pose_origin": origin,
                "pose_version": self.pose_version + 1,
                "note": note,
                "pose_quality": quality or PoseQuality(),
            }
        )


@dataclass(frozen=True)
class Saved:
    """All stored state. `settings` and `configured` are as they were written, possibly by another version.

    Attributes:
        units: by id.
        last_id: the last id that was given to a unit.
        versions: None in the store of a master that never started.
        settings: all of them.
        configured: those that the configuration had set when the master was last started.
        cell: the watched cell.
        cell_file: hash of the cell that was last loaded from a file.
    """

    units: tuple[UnitRecord, ...] = ()
    last_id: int = 0
    versions: Versions | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    configured: dict[str, Any] = field(default_factory=dict)
    cell: Cell | None = None
    cell_file: str = ""


class Store:
    """A connection to the file, which one master holds exclusively; each change is one transaction."""

    def __init__(self, connection: sqlite3.Connection, name: str) -> None:
        """Use `Store.open` or `Store.in_memory`."""
        self._connection = connection
        self._name = name
        self._lock = threading.Lock()
        self._named: frozenset[str] = frozenset()
        self.trouble: str | None = None
        """The reason why the last change could not be stored, in one sentence; None once writing succeeds again."""

    @classmethod
    def in_memory(cls) -> Store:
        """Return a store in memory, which ends with its process."""
        connection = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
        connection.executescript(SCHEMA)
        store = cls(connection, ":memory:")
        # A store without a file is never closed, and Python (3.13) warns of a connection that is left open.
        weakref.finalize(store, connection.close)
        return store

    @classmethod
    def open(cls, path: Path) -> Store:
        """Open the store in this file; make one if there is none.

        Raises:
            ConfigError: the file cannot be read or written, is damaged, is not a master's store or is one of a newer
                version, or another master holds it. The file stays as it is.
        """
        try:
            if not path.exists():
                _make(path)
            connection = sqlite3.connect(path, timeout=LOCK_TIMEOUT_S, isolation_level=None, check_same_thread=False)
        except (sqlite3.Error, OSError) as error:
            raise ConfigError(f"{path}: cannot open the master's store: {error}") from error
        try:
            _check(connection, path)
        except BaseException as error:
            connection.close()
            if isinstance(error, sqlite3.OperationalError) and "locked" in str(error):
                raise ConfigError(f"{path}: another master is running on it; stop that, or use --state-dir") from error
            if isinstance(error, sqlite3.OperationalError):
                raise ConfigError(f"{path}: cannot read and write the master's store: {error}") from error
            if isinstance(error, sqlite3.Error):
                raise _damaged(path, str(error)) from error
            raise
        return cls(connection, str(path))

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._connection.close()

    def load(self) -> Saved:
        """Load all stored state.

        Raises:
            ConfigError: the file is damaged.
        """
        try:
            with self._lock:
                columns = ", ".join(UnitRecord.model_fields)
                rows = self._connection.execute(f"SELECT {columns} FROM units ORDER BY id").fetchall()
                facts = {
                    name: json.loads(value) for name, value in self._connection.execute("SELECT name, value FROM facts")
                }
                meshes = dict(self._connection.execute("SELECT sha256, data FROM meshes").fetchall())
            units = tuple(_record(row) for row in rows)
            self._named = frozenset(meshes)
            return Saved(
                units=units,
                last_id=max([int(facts.get("last_id", 0)), *(unit.id for unit in units)]),
                versions=Versions.model_validate(facts["versions"]) if "versions" in facts else None,
                settings=dict(facts.get("settings", {})),
                configured=dict(facts.get("configured", {})),
                cell=Cell.from_document(facts["cell"], meshes) if "cell" in facts else None,
                cell_file=str(facts.get("cell_file", "")),
            )
        except ValidationError as error:
            raise _damaged(self._name, sentence(error)) from error
        except (sqlite3.Error, CellError, ValueError, TypeError) as error:
            raise _damaged(self._name, str(error)) from error

    # ------------------------------------------------------------------ changes; each raises Refusal, 507

    def begin(
        self, cell: Cell, cell_file: str, settings: Settings, configured: Mapping[str, Any], versions: Versions
    ) -> None:
        """Store the state at start: the watched cell, the hash of the cell in the file, and the settings."""
        document, meshes = cell.to_document()
        with self._transaction() as connection:
            _put(connection, "configured", configured)
            _put(connection, "cell_file", cell_file)
            _put(connection, "settings", settings.model_dump(mode="json"))
            _put_cell(connection, document, meshes)
            _put(connection, "versions", versions.model_dump())
        self._named = frozenset(meshes)

    def save_units(self, changed: Iterable[UnitRecord], gone: Iterable[int] = ()) -> None:
        """Store new or changed units and delete those with the ids `gone`, in one transaction."""
        names = tuple(UnitRecord.model_fields)
        updates = ", ".join(f"{name} = excluded.{name}" for name in names[1:])
        statement = (
            f"INSERT INTO units ({', '.join(names)}) VALUES ({', '.join('?' * len(names))}) "
            f"ON CONFLICT (id) DO UPDATE SET {updates}"
        )
        with self._transaction() as connection:
            connection.executemany("DELETE FROM units WHERE id = ?", [(unit_id,) for unit_id in gone])
            for unit in changed:
                fields = dict(unit)
                fields["T_world_camera"] = None if unit.T_world_camera is None else json.dumps(unit.T_world_camera)
                fields["pose_quality"] = unit.pose_quality.model_dump_json(exclude_none=True)
                fields["intrinsics"] = None if unit.intrinsics is None else unit.intrinsics.model_dump_json()
                connection.execute(statement, tuple(fields.values()))
                connection.execute(
                    "INSERT INTO facts VALUES ('last_id', ?) ON CONFLICT (name) DO UPDATE SET value = excluded.value "
                    "WHERE CAST(excluded.value AS INTEGER) > CAST(value AS INTEGER)",
                    (str(unit.id),),
                )

    def save_settings(self, settings: Settings, versions: Versions) -> None:
        """Store changed settings and the versions that belong to them."""
        with self._transaction() as connection:
            _put(connection, "settings", settings.model_dump(mode="json"))
            _put(connection, "versions", versions.model_dump())

    def add_meshes(self, meshes: Mapping[str, bytes]) -> None:
        """Store meshes by their sha256 before the cell that names them; a thread may call it.

        Earlier ones that no stored cell names, as those of a refused cell, are deleted.
        """
        with self._transaction() as connection:
            _drop_meshes(connection, self._named | set(meshes))
        for mesh in meshes.items():
            with self._transaction() as connection:
                connection.execute("INSERT OR IGNORE INTO meshes VALUES (?, ?)", mesh)

    def save_cell(self, document: Mapping[str, Any], meshes: Mapping[str, bytes], versions: Versions) -> None:
        """Store a cell as of `Cell.to_document` with its versions; drop the meshes of the previous cell."""
        with self._transaction() as connection:
            _put_cell(connection, document, meshes)
            _put(connection, "versions", versions.model_dump())
        self._named = frozenset(meshes)

    # ------------------------------------------------------------------ while nothing can be stored

    async def follow(self) -> None:
        """After a change could not be stored, try to write until that succeeds again; runs until cancelled."""
        while True:
            await asyncio.sleep(TRY_EVERY_S)
            if self.trouble is not None:
                with contextlib.suppress(Refusal):
                    await asyncio.to_thread(self.attempt)

    def attempt(self) -> None:
        """Write and delete a test row; success clears `trouble`. Raises as a change does."""
        with self._transaction() as connection:
            # SQLite does not write a value that equals the old one.
            _put(connection, "attempt", 0)
            connection.execute("DELETE FROM facts WHERE name = 'attempt'")

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                self._connection.execute("BEGIN IMMEDIATE")
                yield self._connection
                self._connection.execute("COMMIT")
            except sqlite3.Error as error:
                sentence = f"cannot store anything in {self._name}: {error}"
                if self.trouble is None:
                    logger.error("%s; changes are refused until it can", sentence, extra={"event": "storage"})
                self.trouble = sentence
                raise Refusal(507, f"nothing was changed: the master cannot store it ({error})") from error
            finally:
                if self._connection.in_transaction:
                    # SQLite has rolled back the failed write itself.
                    with contextlib.suppress(sqlite3.Error):
                        self._connection.execute("ROLLBACK")
            if self.trouble is not None:
                logger.info("changes can be stored again", extra={"event": "storage"})
            self.trouble = None


def _make(path: Path) -> None:
    """Make an empty store, whole or not at all: a file of this name is always a complete store."""
    left_over = path.with_name(path.name + "-wal")
    if left_over.exists():
        raise ConfigError(
            f"{path}: expected the file that {left_over.name} belongs to, got none; "
            f"put it back, or delete {left_over.name} too to start anew"
        )
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    partial = path.with_suffix(".partial")
    for name in (partial, partial.with_name(partial.name + "-wal"), partial.with_name(partial.name + "-journal")):
        name.unlink(missing_ok=True)
    os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    connection = sqlite3.connect(partial, isolation_level=None)
    try:
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.executescript(f"BEGIN; {SCHEMA} COMMIT;")
    finally:
        connection.close()
    partial.replace(path)
    sync_folder(path.parent)


def _check(connection: sqlite3.Connection, path: Path) -> None:
    # An exclusive lock needs no shared memory, and a second master cannot open the file.
    connection.execute("PRAGMA locking_mode = EXCLUSIVE")
    connection.execute("PRAGMA synchronous = FULL")
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise _damaged(path, "it is no store of a master")
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version < min(UPGRADES):
        raise _damaged(path, f"a store of version {version}, which never was")
    if version > SCHEMA_VERSION:
        raise ConfigError(
            f"{path}: expected a store of version {SCHEMA_VERSION}, got version {version}: it was written by a newer "
            "master-server; install that again, put back the copy of before the update, or use another --state-dir"
        )
    # SQLite fills up a truncated page without an error; while there is a log, it holds the whole page.
    log = path.with_name(path.name + "-wal")
    page_bytes = connection.execute("PRAGMA page_size").fetchone()[0]
    if (not log.exists() or log.stat().st_size == 0) and path.stat().st_size % page_bytes:
        raise _damaged(path, "its end is missing")
    if (found := connection.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
        raise _damaged(path, found)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute(f"PRAGMA journal_size_limit = {LOG_BYTES}")
    # Take the write lock: a read alone would not lock out other processes.
    connection.execute("BEGIN IMMEDIATE")
    if version < SCHEMA_VERSION:
        for older in range(version, SCHEMA_VERSION):
            connection.execute(UPGRADES[older])
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    connection.execute("COMMIT")


def _damaged(path: Path | str, what: str) -> ConfigError:
    return ConfigError(
        f"{path}: expected a master's store, got something else or a damaged file ({what}); "
        "put back a copy, or move away all files whose names begin with its name to start anew: units, poses and "
        "settings must then be set again"
    )


def _record(row: tuple[Any, ...]) -> UnitRecord:
    fields = dict(zip(UnitRecord.model_fields, row, strict=True))
    for name in ("T_world_camera", "pose_quality", "intrinsics"):
        fields[name] = None if fields[name] is None else json.loads(fields[name])
    return UnitRecord.model_validate(fields)


def _put(connection: sqlite3.Connection, name: str, value: Any) -> None:
    connection.execute("INSERT OR REPLACE INTO facts VALUES (?, ?)", (name, json.dumps(value)))


def _put_cell(connection: sqlite3.Connection, document: Mapping[str, Any], meshes: Mapping[str, bytes]) -> None:
    _put(connection, "cell", document)
    stored = _drop_meshes(connection, meshes)
    news = [mesh for mesh in meshes.items() if mesh[0] not in stored]
    connection.executemany("INSERT INTO meshes VALUES (?, ?)", news)


def _drop_meshes(connection: sqlite3.Connection, named: Collection[str]) -> set[str]:
    """Drop all meshes but the `named` ones; return those that are stored."""
    stored = {sha256 for (sha256,) in connection.execute("SELECT sha256 FROM meshes")}
    old = stored.difference(named)
    connection.executemany("DELETE FROM meshes WHERE sha256 = ?", [(sha256,) for sha256 in old])
    return stored - old
