# SPDX-License-Identifier: Apache-2.0
"""Padded hulls kept on disk, so that a robot of fine CAD costs its seconds at the first start only.

They lie beside the compiled kernels, each in a file that is named by its mesh, its distance and the code that made it.
A file begins with the SHA-256 of its name and of what follows, the hull's canonical bytes; one that is damaged is taken
out and made anew. Nothing depends on them: where they cannot be written, a warning says so once.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterable
from pathlib import Path

from shared.errors import MeshError
from shared.files import write_whole
from shared.meshes import TriangleMesh

logger = logging.getLogger(__name__)

FOLDER = "hulls"

FILES_MAX = 512
"""Hulls kept: those of some thirty robots, each with its tools and one padding."""

BYTES_MAX = 64_000_000
"""Of all files together: a hull has 20 to 40 kB, one that could not be simplified 2 MB."""

_DIGEST_BYTES = hashlib.sha256().digest_size


def state_of_code(sources: Iterable[Path], libraries: Iterable[str]) -> str:
    """Return a digest of the code that makes hulls: source files, and libraries as words with their versions.

    Raises:
        OSError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for part in (*(source.read_bytes() for source in sources), *(library.encode() for library in libraries)):
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()


class HullStore:
    """Hulls in a folder of their own, at most `FILES_MAX` and `BYTES_MAX`: those not used for longest go first."""

    def __init__(self, folder: Path, code_state: str) -> None:
        """`code_state` changes when the same mesh would have another hull; the folder need not exist."""
        self._folder = folder
        self._code_state = code_state
        self._warned = False

    def load(self, mesh: TriangleMesh, distance_m: float) -> TriangleMesh | None:
        """Return the hull at `distance_m` around `mesh`; None where it is not kept, or its file was damaged."""
        path = self._path(mesh, distance_m)
        try:
            if path.stat().st_size > BYTES_MAX:
                raise MeshError(f"expected at most {BYTES_MAX} bytes")
            content = path.read_bytes()
            payload = content[_DIGEST_BYTES:]
            if content[:_DIGEST_BYTES] != _digest(path, payload):
                raise MeshError("its checksum does not fit")
            hull = TriangleMesh.from_bytes(payload, mesh.name)
        except FileNotFoundError:
            return None
        except MeshError as error:
            logger.warning("%s: damaged, the hull of %s is made anew: %s", path, mesh.name, error)
            self._remove(path)
            return None
        except OSError as error:
            self._warn("read", error)
            return None
        try:
            os.utime(path)
        except OSError as error:
            logger.debug("%s: its time of use cannot be noted: %s", path, error)
        return hull

    def save(self, mesh: TriangleMesh, distance_m: float, hull: TriangleMesh) -> None:
        """Keep a hull; what cannot be written is not kept, and a warning says so once."""
        path, payload = self._path(mesh, distance_m), hull.to_bytes()
        size = _DIGEST_BYTES + len(payload)
        if size > BYTES_MAX:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._make_room(size)
            # One that a power cut leaves damaged is found out by its checksum.
            write_whole(path, _digest(path, payload) + payload, synced=False, contended=True)
        except OSError as error:
            self._warn("written", error)

    def _path(self, mesh: TriangleMesh, distance_m: float) -> Path:
        name = hashlib.sha256(f"{self._code_state} {mesh.sha256} {distance_m!r}".encode()).hexdigest()
        return self._folder / name

    def _make_room(self, size: int) -> None:
        """Take out what was not used for longest, until one more file of so many bytes has room."""
        files = []
        for path in self._folder.iterdir():
            try:
                status = path.stat()
            except FileNotFoundError:
                # Another process makes room, too.
                continue
            files.append((status.st_mtime_ns, status.st_size, path))
        files.sort()
        total, count = sum(length for _, length, _ in files) + size, len(files) + 1
        for _, length, path in files:
            if total <= BYTES_MAX and count <= FILES_MAX:
                return
            path.unlink(missing_ok=True)
            total, count = total - length, count - 1

    def _remove(self, path: Path) -> None:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            self._warn("removed", error)

    def _warn(self, verb: str, error: OSError) -> None:
        if not self._warned:
            self._warned = True
            logger.warning(
                "%s: the hulls of the robots' links cannot be %s (%s): they are made anew at each start",
                self._folder,
                verb,
                error,
            )


def _digest(path: Path, payload: bytes) -> bytes:
    return hashlib.sha256(path.name.encode() + payload).digest()
