# SPDX-License-Identifier: Apache-2.0
"""`python -m master_server.cells.unpacking ARCHIVE FOLDER`: turn the zip of a cell's folder into a document and meshes.

This is a process of its own for two reasons: reading CAD takes seconds, in which no unit may wait, and the files came
over the network. The process opens only files in the cell's folder and those that Python itself consists of.
"""

from __future__ import annotations

import json
import os
import resource
import stat
import sys
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from shared.cell import Cell
from shared.errors import CellError, CellwatchError

MAX_FILES = 4000
"""A cell of MAX_BODIES bodies of each kind, a robot, and additional files of CAD programs. Bounds the files on disk."""

MAX_FILE_BYTES = 256 * 2**20
"""A mesh of MAX_TRIANGLES as text; the same mesh as binary STL takes a fifth of it."""

MAX_UNPACKED_BYTES = 512 * 2**20
"""Bound of all files together: fits on a small disk or in memory while a cell is read, at any compression."""

MAX_MEMORY_BYTES = 4 * 2**30
"""Bound of memory: twenty times the largest mesh as text. The process refuses a file that claims more, and the master
keeps running."""

CELL_FILE = "cell.yaml"

REASON_CHARS = 2000
"""Longest error message."""

NICENESS = 10
"""Niceness of this process: updates of units have priority."""

DOCUMENT, MESHES = "document.json", "meshes"
"""Names of the results in the folder: the document, and the meshes."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. Print an error in the cell as one sentence and return 1."""
    archive, folder = (Path(argument).resolve() for argument in arguments or sys.argv[1:])
    os.nice(NICENESS)
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
    unpacked = folder / "cell"
    try:
        unpack(archive, unpacked)
        stay_inside(folder)
        cell = Cell.load(cell_file_in(unpacked))
        write(cell, folder)
    except CellwatchError as error:
        reason = "; ".join(str(error).replace(f"{unpacked}/", "").splitlines())
        print(reason[:REASON_CHARS])
        return 1
    except MemoryError:
        print(f"cell: reading it needs more than {MAX_MEMORY_BYTES >> 30} GiB of memory; simplify its meshes")
        return 1
    return 0


def unpack(archive: Path, folder: Path) -> None:
    """Unpack plain files within the bounds.

    Raises:
        CellError: the file is no zip, is too large, or has an entry that is a link, encrypted or outside of the folder.
    """
    try:
        with zipfile.ZipFile(archive) as packed:
            entries = packed.infolist()
            _check_sizes(entries)
            for entry in entries:
                target = folder / _place_of(entry)
                if entry.is_dir():
                    continue
                target.parent.mkdir(parents=True, exist_ok=True)
                # Read no more than the entry claims to hold; a wrong claim makes the checksum fail.
                with packed.open(entry) as source, target.open("wb") as copy:
                    while chunk := source.read(2**20):
                        copy.write(chunk)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, UnicodeError) as error:
        raise CellError(f"expected the cell's folder as a zip, got a damaged one: {error}") from error
    except OSError as error:
        raise CellError(f"the zip cannot be unpacked: {error.strerror or error}") from error


def cell_file_in(folder: Path) -> Path:
    """Return the cell file at the root or in the only top folder.

    Raises:
        CellError: there is no such file, or more than one.
    """
    if (folder / CELL_FILE).is_file():
        return folder / CELL_FILE
    found = sorted(folder.glob(f"*/{CELL_FILE}"))
    if len(found) != 1:
        came = f"{len(found)} folders with one" if found else "none"
        raise CellError(f"zip: expected {CELL_FILE} at its root or in its one top folder, got {came}")
    return found[0]


def stay_inside(folder: Path) -> None:
    """Bar this process for good from opening files outside of `folder`, except those that Python consists of."""
    own = {os.path.realpath(path) for path in (sys.prefix, sys.base_prefix, sys.exec_prefix, *sys.path) if path}
    roots = tuple(f"{root.rstrip('/')}/" for root in {*own, os.path.realpath(folder)})

    def check(event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" or not isinstance(arguments[0], (str, bytes)):
            return
        path = os.path.realpath(os.fsdecode(arguments[0]))
        if not path.startswith(roots):
            raise PermissionError(13, "it lies outside of the cell's folder", path)

    sys.addaudithook(check)


def write(cell: Cell, folder: Path) -> None:
    """Write the cell's document and meshes to `folder`.

    Raises:
        CellError: the disk is full.
    """
    document, meshes = cell.to_document()
    try:
        (folder / MESHES).mkdir()
        for sha256, data in meshes.items():
            (folder / MESHES / sha256).write_bytes(data)
        (folder / DOCUMENT).write_text(json.dumps(document), encoding="utf-8")
    except OSError as error:
        raise CellError(f"the cell cannot be written to the disk: {error.strerror or error}") from error


def _check_sizes(entries: Sequence[zipfile.ZipInfo]) -> None:
    if len(entries) > MAX_FILES:
        raise CellError(f"zip: expected at most {MAX_FILES} files and folders, got {len(entries)}")
    largest = max(entries, key=lambda entry: entry.file_size, default=None)
    if largest is not None and largest.file_size > MAX_FILE_BYTES:
        raise CellError(
            f"zip: {_shown(largest)}: expected at most {MAX_FILE_BYTES >> 20} MiB in one file, "
            f"got {largest.file_size >> 20}"
        )
    total = sum(entry.file_size for entry in entries)
    if total > MAX_UNPACKED_BYTES:
        raise CellError(f"zip: expected at most {MAX_UNPACKED_BYTES >> 20} MiB unpacked, got {total >> 20}")


def _place_of(entry: zipfile.ZipInfo) -> PurePosixPath:
    """Return the path of an entry below the folder."""
    place = PurePosixPath(entry.filename)
    if place.is_absolute() or ".." in place.parts or "\\" in entry.filename or ":" in entry.filename:
        raise CellError(f"zip: {_shown(entry)}: expected a path inside of the folder, got one that leaves it")
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise CellError(f"zip: {_shown(entry)}: expected a plain file, got a link or device; zip without -y")
    if entry.flag_bits & 1:
        raise CellError(f"zip: {_shown(entry)}: expected a file that can be read, got an encrypted one")
    return place


def _shown(entry: zipfile.ZipInfo) -> str:
    """Return an entry's name for a message."""
    name = entry.filename[:100]
    return name if name.isprintable() else repr(name)


if __name__ == "__main__":
    sys.exit(main())
