# SPDX-License-Identifier: Apache-2.0
"""Files of which a power cut leaves all or nothing, and small documents that outlive a program in them."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

Parsed = TypeVar("Parsed")

logger = logging.getLogger(__name__)

STATE_MAX_BYTES = 10_000
"""Some ten times the longest document that is kept as state; what is longer is none of ours."""

UNREADABLE = (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError)
"""What reading and parsing a damaged document raises."""


def default_state_dir(program: str) -> Path:
    """The folder where a service manager, or else the user's own conventions, want a program's state to be kept."""
    if managed := os.environ.get("STATE_DIRECTORY"):
        return Path(managed.split(":")[0])
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "cellwatch" / program


def write_whole(path: Path, content: bytes, *, synced: bool = True, contended: bool = False) -> None:
    """Write a file whole or not at all; where it is `contended`, several processes may do so at a time.

    When it is `synced` it is on the disk once this returns. Without, it is only whole for those who read it while the
    power stays on: for what is read by another process, or checked and made anew when it is damaged.

    Raises:
        OSError: it cannot be written; what was there stays.
    """
    partial = path.with_suffix(f".{os.getpid()}.partial") if contended else path.with_suffix(".partial")
    _write(path, content, 0o666, None, synced, partial)


def write_private(path: Path, content: bytes, owner: tuple[int, int] | None = None) -> None:
    """Write a file whole or not at all, at no moment readable by others (mode 0600); on the disk once this returns.

    `owner` is the user's and the group's number that the file is given to.

    Raises:
        OSError: it cannot be written; what was there stays.
    """
    _write(path, content, 0o600, owner, synced=True, partial=path.with_suffix(".partial"))


def sync_folder(folder: Path) -> None:
    """Have the names of a folder's files on the disk, as fsync has their content.

    Raises:
        OSError: it cannot be opened, or the disk fails.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class StateFile:
    """One small JSON document in a program's state, which must do without: what goes wrong with it is a warning."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def save(self, document: dict[str, Any]) -> None:
        """Keep `document` in place of the one before; the same one is not written again."""
        content = json.dumps(document).encode()
        try:
            if self._path.is_file() and self._path.read_bytes() == content:
                return
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self._path, content)
        except OSError as error:
            logger.warning("%s: cannot be written: %s", self._path, error)

    def load(self, parse: Callable[[Any], Parsed]) -> Parsed | None:
        """What `parse` makes of the document, or None when there is none; a damaged one is as good as none.

        `parse` raises ValueError, KeyError, TypeError or OverflowError where the document is none of ours.
        """
        try:
            if self._path.stat().st_size > STATE_MAX_BYTES:
                raise ValueError(f"expected at most {STATE_MAX_BYTES} bytes")
            return parse(json.loads(self._path.read_bytes()))
        except FileNotFoundError:
            return None
        except UNREADABLE as error:
            logger.warning("%s: passed over: %s", self._path, " ".join(str(error).split()))
            return None

    def drop(self) -> None:
        """Forget it.

        Raises:
            OSError: it cannot be removed.
        """
        self._path.unlink(missing_ok=True)


def _write(path: Path, content: bytes, mode: int, owner: tuple[int, int] | None, synced: bool, partial: Path) -> None:
    try:
        with os.fdopen(_new(partial, mode), "wb") as file:
            if owner is not None:
                os.fchown(file.fileno(), *owner)
            file.write(content)
            file.flush()
            if synced:
                os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
    if synced:
        sync_folder(path.parent)


def _new(path: Path, mode: int) -> int:
    """Open a file that nobody else has open; what was left of a write that was cut short is taken away."""
    try:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    except FileExistsError:
        path.unlink()
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
