# SPDX-License-Identifier: Apache-2.0
"""Padded hulls stored on disk, so that the hulls of fine CAD cost seconds at the first start only.

They are beside the compiled kernels. Each file is named by a digest of its mesh, its distance and the code that made
it. A file starts with the SHA-256 of its name and of the hull's canonical bytes, which follow. A damaged file is
removed and its hull made again. Nothing depends on the files: if they cannot be written, one warning says so.
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
"""Limit of stored hulls: those of about thirty robots, each with its tools and one padding."""

BYTES_MAX = 64_000_000
"""Limit of all files together: a hull has 20 to 40 kB, one that could not be simplified 2 MB."""

_DIGEST_BYTES = hashlib.sha256().digest_size


def state_of_code(sources: Iterable[Path], libraries: Iterable[str]) -> str:
    """Return a digest of the code that makes hulls, from source files and from libraries as names with versions.

    Raises:
        OSError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for part in (*(source.read_bytes() for source in sources), *(library.encode() for library in libraries)):
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()


class HullStore:
    """Hulls in a folder of their own, at most `FILES_MAX` and `BYTES_MAX`; the least recently used go first."""

    def __init__(self, folder: Path, code_state: str) -> None:
        """Use `folder`, which need not exist; `code_state` changes when the same mesh would have another hull."""
        self._folder = folder
        self._code_state = code_state
        self._warned = False

    def load(self, mesh: TriangleMesh, distance_m: float) -> TriangleMesh | None:
        """Return the hull at `distance_m` around `mesh`, or None if it is not stored or its file was damaged."""
        path = self._path(mesh, distance_m)
        try:
            if path.stat().st_size > BYTES_MAX:
                raise MeshError(f"expected at most {BYTES_MAX} bytes")
            content = path.read_bytes()
            payload = content[_DIGEST_BYTES:]
            if content[:_DIGEST_BYTES] != _digest(path, payload):
                raise MeshError("expected the checksum of its content, got another")
            hull = TriangleMesh.from_bytes(payload, mesh.name)
        except FileNotFoundError:
            return None
        except MeshError as error:
            logger.warning("%s: damaged, so the hull of %s is made again: %s", path, mesh.name, error)
            self._remove(path)
            return None
        except OSError as error:
            self._warn("read", error)
            return None
        try:
            os.utime(path)
        except OSError as error:
            logger.debug("%s: cannot update its time of use: %s", path, error)
        return hull

    def save(self, mesh: TriangleMesh, distance_m: float, hull: TriangleMesh) -> None:
        """Store a hull; if it cannot be written, log one warning."""
        path, payload = self._path(mesh, distance_m), hull.to_bytes()
        size = _DIGEST_BYTES + len(payload)
        if size > BYTES_MAX:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._make_room(size)
            # The checksum detects a file that a power cut damaged.
            write_whole(path, _digest(path, payload) + payload, synced=False, contended=True)
        except OSError as error:
            self._warn("written", error)

    def _path(self, mesh: TriangleMesh, distance_m: float) -> Path:
        name = hashlib.sha256(f"{self._code_state} {mesh.sha256} {distance_m!r}".encode()).hexdigest()
        return self._folder / name

    def _make_room(self, size: int) -> None:
        """Remove the least recently used files until one more file of this size has room."""
        files = []
        for path in self._folder.iterdir():
            try:
                status = path.stat()
            except FileNotFoundError:
                # Another process may remove files at the same time.
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
                "%s: the hulls of the robots' links cannot be %s (%s); they are made again at each start",
                self._folder,
                verb,
                error,
            )


def _digest(path: Path, payload: bytes) -> bytes:
    return hashlib.sha256(path.name.encode() + payload).digest()
