# SPDX-License-Identifier: Apache-2.0
"""The master's cell, kept on disk so that a restarted unit does not have to fetch it again."""

from __future__ import annotations

import asyncio
import json
import logging
from pathlib import Path
from typing import Any

from edge_unit.uplink.client import MasterClient
from shared.cell import Cell
from shared.errors import CellwatchError, WireError
from shared.files import write_whole
from shared.messages import CellReference

logger = logging.getLogger(__name__)

MAX_MESHES = 1000
"""Maximum number of meshes of one cell: more than the bodies and links that a cell may have."""


class CellCache:
    """A folder with the document of the last cell, and with its meshes by their hashes."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._last: Cell | None = None

    async def get(self, reference: CellReference, client: MasterClient) -> Cell:
        """Return the cell that the master watches. Parts that are on disk are not fetched.

        As long as the cell does not change, each call returns the same object.

        Raises:
            UplinkError: the master does not send the cell.
            WireError: the answer is not the cell of `reference`.
            CellError: the answer is not a valid cell.
        """
        if self._last is not None and self._last.version == reference.sha256:
            return self._last
        document = await asyncio.to_thread(self._read_document, reference.sha256)
        fetched = document is None
        if document is None:
            document = await client.cell_document()
        last = self._last
        in_memory = set() if last is None else set(last.meshes)
        named = mesh_hashes(document)
        meshes: dict[str, bytes] = {}
        for sha256 in set(named) - in_memory:
            data = await asyncio.to_thread(self._read_mesh, sha256)
            if data is None:
                data = await client.mesh(sha256)
                await asyncio.to_thread(self._write, f"{sha256}.mesh", data)
            meshes[sha256] = data
        try:
            cell = await asyncio.to_thread(Cell.from_document, document, meshes, last)
            if cell.version != reference.sha256:
                raise WireError(
                    f"cell {reference.name}: expected version {reference.sha256[:8]}, got {cell.version[:8]}"
                )
        except CellwatchError:
            # The master's cell changed between two answers, or a file on disk is damaged. Fetch all files again.
            await asyncio.to_thread(self._keep_only, set())
            raise
        if fetched:
            await asyncio.to_thread(self._keep, reference.sha256, document, set(named))
        self._last = cell
        return cell

    def _read_document(self, sha256: str) -> dict[str, Any] | None:
        try:
            document = json.loads((self._folder / f"{sha256}.json").read_bytes())
        except (OSError, ValueError):
            return None
        return document if isinstance(document, dict) else None

    def _read_mesh(self, sha256: str) -> bytes | None:
        try:
            return (self._folder / f"{sha256}.mesh").read_bytes()
        except OSError:
            return None

    def _keep(self, sha256: str, document: dict[str, Any], meshes: set[str]) -> None:
        self._write(f"{sha256}.json", json.dumps(document).encode())
        self._keep_only({f"{sha256}.json", *(f"{mesh}.mesh" for mesh in meshes)})

    def _write(self, name: str, data: bytes) -> None:
        """Write the whole file or nothing. If the disk is full, the unit works on without this file."""
        path = self._folder / name
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            # Not synced, so a start does not wait for the disk. The hash shows damage by a power cut, and the file is
            # fetched again.
            write_whole(path, data, synced=False)
        except OSError as error:
            logger.warning("%s: the cell cannot be kept, and is fetched again after a restart: %s", path, error)

    def _keep_only(self, names: set[str]) -> None:
        try:
            for file in self._folder.iterdir() if self._folder.is_dir() else ():
                if file.name not in names:
                    file.unlink(missing_ok=True)
        except OSError as error:
            logger.warning("%s: files of old cells cannot be removed: %s", self._folder, error)


def mesh_hashes(document: dict[str, Any]) -> list[str]:
    """Return the hashes of all meshes in a cell's document, at any depth: 64 hexadecimal digits under `mesh`.

    Raises:
        CellwatchError: there are more than `MAX_MESHES`.
    """
    found: set[str] = set()
    pending: list[Any] = [document]
    while pending:
        item = pending.pop()
        if isinstance(item, dict):
            mesh = item.get("mesh")
            if isinstance(mesh, str) and len(mesh) == 64 and set(mesh) <= set("0123456789abcdef"):
                found.add(mesh)
            pending.extend(item.values())
        elif isinstance(item, (list, tuple)):
            pending.extend(item)
    if len(found) > MAX_MESHES:
        raise CellwatchError(f"cell: expected at most {MAX_MESHES} meshes, got {len(found)}")
    return sorted(found)
