# SPDX-License-Identifier: Apache-2.0
"""Atomic writes of files, and small state documents in files.

A power cut leaves the old file or the new one, never a part of either.
"""

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
"""About ten times the longest document that is kept as state; a longer file is not a state document of this project."""

UNREADABLE = (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError)
"""Exceptions raised when a damaged document is read and parsed."""


def default_state_dir(program: str) -> Path:
    """Return the state folder of a program: the service manager's, else the one of the XDG convention."""
    if managed := os.environ.get("STATE_DIRECTORY"):
        return Path(managed.split(":")[0])
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "cellwatch" / program


def write_whole(path: Path, content: bytes, *, synced: bool = True, contended: bool = False) -> None:
    """Write a file atomically.

    `contended` allows several processes to write the file at the same time. With `synced`, the file is on the disk
    when this returns. Without it, the write is atomic for readers only while the power stays on: use that for files
    that only another process reads, or that are checked and written again when damaged.

    Raises:
        OSError: the file cannot be written; the old content stays.
    """
    partial = path.with_suffix(f".{os.getpid()}.partial") if contended else path.with_suffix(".partial")
    _write(path, content, 0o666, None, synced, partial)


def write_private(path: Path, content: bytes, owner: tuple[int, int] | None = None) -> None:
    """Write a file atomically with mode 0600, at no moment readable by others; it is on the disk when this returns.

    `owner` gives the file to this user and group number.

    Raises:
        OSError: the file cannot be written; the old content stays.
    """
    _write(path, content, 0o600, owner, synced=True, partial=path.with_suffix(".partial"))


def sync_folder(folder: Path) -> None:
    """Flush the directory entries of `folder` to the disk, as fsync does for the content of files.

    Raises:
        OSError: the folder cannot be opened, or the disk fails.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class StateFile:
    """One small JSON document of a program's state. The program works without it: each failure is only a warning."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def save(self, document: dict[str, Any]) -> None:
        """Replace the stored document by `document`; an equal document is not written again."""
        content = json.dumps(document).encode()
        try:
            if self._path.is_file() and self._path.read_bytes() == content:
                return
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self._path, content)
        except OSError as error:
            logger.warning("%s: cannot be written: %s", self._path, error)

    def load(self, parse: Callable[[Any], Parsed]) -> Parsed | None:
        """Return the document as parsed by `parse`, or None when it is missing or damaged.

        `parse` raises ValueError, KeyError, TypeError or OverflowError when the document is not valid.
        """
        try:
            if self._path.stat().st_size > STATE_MAX_BYTES:
                raise ValueError(f"expected at most {STATE_MAX_BYTES} bytes")
            return parse(json.loads(self._path.read_bytes()))
        except FileNotFoundError:
            return None
        except UNREADABLE as error:
            logger.warning("%s: ignored, since it cannot be read: %s", self._path, " ".join(str(error).split()))
            return None

    def drop(self) -> None:
        """Delete the document.

        Raises:
            OSError: the file cannot be removed.
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
    """Create and open a file exclusively; remove the remainder of an interrupted write."""
    try:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    except FileExistsError:
        path.unlink()
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
