# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept, settled before the first is imported.

numba looks for a folder that it can write when a kernel is *defined*, and raises when there is none; so a service
without a home of its own would not even start. A folder that was filled before but is read-only counts as none.

It compiles a kernel anew when the kernel's own file has changed, and not when that of a kernel or a constant has which
it uses. So each state of all the kernels has a folder of its own. Kernels that came with the release are found in it,
where they fit (`prebuilt`); otherwise they are compiled for this very processor.

It waits for no disk when it writes, and takes what it finds for whole: after a power cut it would raise at each start.
So files that are empty or cut short are taken out, and compiled anew.
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
"""States of the kernels that are kept: this one, and what one may go back to."""

PRIVATE = "cellwatch-jit-"
"""Of a temporary folder, which is gone after the next boot."""


def settle(directory: Path | str | None = None) -> Path:
    """Choose the folder for compiled kernels; call it before any kernel is imported.

    In `directory`, else `$CELLWATCH_JIT_CACHE`, else `$NUMBA_CACHE_DIR`, else where numba would, if it can be written;
    else in a private temporary folder, with a warning. Returns the folder of the kernels as they are.

    Raises:
        JitCacheError: not even a temporary folder can be made, or the kernels' source is not found.
    """
    wanted = next((Path(name) for name in (directory, *map(os.environ.get, VARIABLES)) if name), None)
    if wanted is not None and wanted.name.startswith(PREFIX):
        # Handed down by a process that has settled already.
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
    """Return the folder `name` beside those of the kernels, wherever they were settled; it need not exist."""
    return Path(os.environ[NUMBA_VARIABLE]).parent / name


def settle_for(target: Target, directory: Path) -> Path:
    """Have all kernels compiled for `target`, to be carried by a release, into a folder below `directory`.

    Raises:
        JitCacheError: it cannot be written, or the kernels' source is not found.
    """
    folder = directory / target.name / f"{PREFIX}{_state()}"
    if not _writable(folder):
        raise JitCacheError(f"{folder} cannot be written")
    target.choose()
    _tell_numba(folder)
    return folder


def _use(parent: Path) -> Path:
    state = _state()
    folder = parent / f"{PREFIX}{state}"
    found = carried(state)
    if found is not None:
        target, kernels = found
        # Where not even links can be made, it is compiled for this processor.
        with suppress(OSError):
            folder = link(kernels, parent)
            target.choose()
    with suppress(OSError):
        # A folder that another process is taking out at the same time is as good as taken out.
        folder.mkdir(exist_ok=True)
        os.utime(folder)
        states = sorted(parent.glob(f"{PREFIX}*"), key=lambda path: path.stat().st_mtime)
        # What a power cut left of a folder of links; one that is being made is younger than any state.
        left_behind = [path for path in parent.glob(f"{PARTIAL}*") if path.stat().st_mtime < states[0].stat().st_mtime]
        for old in (*states[:-STATES_MAX], *left_behind):
            shutil.rmtree(old, ignore_errors=True)
    _take_out_damaged(folder)
    _tell_numba(folder)
    return folder


def _take_out_damaged(folder: Path) -> None:
    for file in folder.glob("*/*.nb[ic]"):
        try:
            if not _is_whole(file.read_bytes()):
                logger.warning("%s: damaged, its kernel is compiled anew", file)
                file.unlink(missing_ok=True)
        except OSError as error:
            logger.warning("%s: a compiled kernel cannot be read: %s", file, error)


def _is_whole(content: bytes) -> bool:
    """Whether it is one pickle after another to its end; none of them is loaded."""
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


def _tell_numba(folder: Path) -> None:
    os.environ[NUMBA_VARIABLE] = str(folder)
    if "numba" in sys.modules:
        # It reads the variable only when it is imported.
        import numba

        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]  # numba sets its options from outside


def _state() -> str:
    try:
        return state_of_kernels()
    except OSError as error:
        raise JitCacheError(f"compiled kernels cannot be told apart: {error}") from error


def _numba_choices() -> list[Path]:
    """Where numba looks by itself: beside the source, then in the user's cache."""
    beside = KERNELS / "__pycache__"
    cache_home = os.environ.get("XDG_CACHE_HOME")
    try:
        return [beside, Path(cache_home) / "numba" if cache_home else Path.home() / ".cache" / "numba"]
    except RuntimeError:  # a user without a home
        return [beside]


def _writable(folder: Path) -> bool:
    """Whether a file can really be made there; permissions alone do not tell of read-only file systems."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _private_folder() -> Path:
    """A folder that only this user can have filled, the same at each start where possible: kernels are code."""
    try:
        folder = Path(tempfile.gettempdir()) / f"{PRIVATE}{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077:
            return folder
        return Path(tempfile.mkdtemp(prefix=PRIVATE))
    except OSError as error:
        raise JitCacheError(f"no folder for compiled kernels can be made, not even a temporary one: {error}") from error
