# SPDX-License-Identifier: Apache-2.0
"""The folder of compiled kernels, chosen before the first kernel is imported.

numba looks for a writable folder when a kernel is *defined*, and raises when there is none. A service without a home
of its own would not even start. A folder that was filled before but is now read-only does not count as writable.

numba recompiles a kernel when the kernel's own file has changed, but not when another kernel or constant that it uses
has. So each state of the kernels' source has a folder of its own. Kernels shipped with the release are linked into it
if they fit (`prebuilt`); otherwise they are compiled for this processor.

numba does not flush its files to the disk, and does not check them: a file damaged by a power cut would raise at each
start. So empty and truncated files are removed, and their kernels compiled again.
"""

from __future__ import annotations

import logging
import os
import pickletools
import shutil
import stat
import sys
import tempfile
from contextlib import suppress
from io import BytesIO
from pathlib import Path

from geometry.compilation.kernel_state import state_of_kernels
from geometry.compilation.prebuilt import PARTIAL, PREFIX, Target, carried, link
from shared.errors import JitCacheError

logger = logging.getLogger(__name__)

NUMBA_VARIABLE = "NUMBA_CACHE_DIR"

VARIABLES = ("CELLWATCH_JIT_CACHE", NUMBA_VARIABLE)

KERNELS = Path(__file__).resolve().parents[1] / "kernels"

STATES_MAX = 3
"""Number of states kept: the current one, and earlier ones for a rollback."""

PRIVATE = "cellwatch-jit-"
"""Prefix of a temporary folder, which is gone after the next boot."""


def settle(directory: Path | str | None = None) -> Path:
    """Choose the folder for compiled kernels, and return it; call this before any kernel is imported.

    Use the first that is set of `directory`, `$CELLWATCH_JIT_CACHE`, `$NUMBA_CACHE_DIR` and numba's own choices. If it
    cannot be written, use a private temporary folder and log a warning. The result is the subfolder for the current
    state of the kernels.

    Raises:
        JitCacheError: not even a temporary folder can be created, or the kernels' source is missing.
    """
    wanted = next((Path(name) for name in (directory, *map(os.environ.get, VARIABLES)) if name), None)
    if wanted is not None and wanted.name.startswith(PREFIX):
        # Inherited from a process that has already chosen.
        wanted = wanted.parent
    if wanted is not None and _writable(wanted):
        return _use(wanted)
    for folder in _numba_choices() if wanted is None else ():
        if _writable(folder):
            return _use(folder)
    private = _private_folder()
    logger.warning(
        "compiled kernels are kept in %s, since %s cannot be written; set %s to a folder that can",
        private,
        wanted or " nor ".join(str(folder) for folder in _numba_choices()),
        VARIABLES[0],
    )
    return _use(private)


def folder_beside(name: str) -> Path:
    """Return the folder `name` beside those of the kernels; it need not exist."""
    return Path(os.environ[NUMBA_VARIABLE]).parent / name


def settle_for(target: Target, directory: Path) -> Path:
    """Compile all kernels from now on for `target`, for shipping with a release, into a folder below `directory`.

    Raises:
        JitCacheError: the folder cannot be written, or the kernels' source is missing.
    """
    folder = directory / target.name / f"{PREFIX}{_state()}"
    if not _writable(folder):
        raise JitCacheError(f"{folder} cannot be written")
    target.choose()
    _set_numba_folder(folder)
    return folder


def _use(parent: Path) -> Path:
    state = _state()
    folder = parent / f"{PREFIX}{state}"
    found = carried(state)
    if found is not None:
        target, kernels = found
        # If links cannot be created, compile for this processor.
        with suppress(OSError):
            folder = link(kernels, parent)
            target.choose()
    with suppress(OSError):
        # Another process may remove the same folder at the same time.
        folder.mkdir(exist_ok=True)
        os.utime(folder)
        states = sorted(parent.glob(f"{PREFIX}*"), key=lambda path: path.stat().st_mtime)
        # Folders of links left by a power cut; a folder that is being filled is younger than any state.
        left_behind = [path for path in parent.glob(f"{PARTIAL}*") if path.stat().st_mtime < states[0].stat().st_mtime]
        for old in (*states[:-STATES_MAX], *left_behind):
            shutil.rmtree(old, ignore_errors=True)
    _remove_damaged(folder)
    _set_numba_folder(folder)
    return folder


def _remove_damaged(folder: Path) -> None:
    for file in folder.glob("*/*.nb[ic]"):
        try:
            if not _is_whole(file.read_bytes()):
                logger.warning("%s: damaged; its kernel will be compiled again", file)
                file.unlink(missing_ok=True)
        except OSError as error:
            logger.warning("%s: cannot read this compiled kernel: %s", file, error)


def _is_whole(content: bytes) -> bool:
    """Return True if `content` is a sequence of complete pickles; do not load them."""
    stream = BytesIO(content)
    try:
        for _ in pickletools.genops(stream):
            pass
        while stream.tell() < len(content):
            for _ in pickletools.genops(stream):
                pass
    except (ValueError, OverflowError):
        return False
    return True


def _set_numba_folder(folder: Path) -> None:
    os.environ[NUMBA_VARIABLE] = str(folder)
    if "numba" in sys.modules:
        # numba reads the variable only at its import.
        import numba

        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]  # numba sets its options from outside


def _state() -> str:
    try:
        return state_of_kernels()
    except OSError as error:
        raise JitCacheError(f"no digest of the kernels' source: {error}") from error


def _numba_choices() -> list[Path]:
    """Return numba's own choices: beside the source, then in the user's cache."""
    beside = KERNELS / "__pycache__"
    cache_home = os.environ.get("XDG_CACHE_HOME")
    try:
        return [beside, Path(cache_home) / "numba" if cache_home else Path.home() / ".cache" / "numba"]
    except RuntimeError:  # a user without a home
        return [beside]


def _writable(folder: Path) -> bool:
    """Return True if a file can really be created there; permissions do not show a read-only file system."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _private_folder() -> Path:
    """Return a folder that only this user can have filled, if possible the same at each start: kernels are code."""
    try:
        folder = Path(tempfile.gettempdir()) / f"{PRIVATE}{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077:
            return folder
        return Path(tempfile.mkdtemp(prefix=PRIVATE))
    except OSError as error:
        raise JitCacheError(f"no folder for compiled kernels can be made, not even a temporary one: {error}") from error
