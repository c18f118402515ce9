# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_unit.uplink.cell_cache import CellCache
from shared.cell import Cell, PlacedMesh
from shared.errors import CellwatchError, WireError
from shared.meshes import box_mesh
from shared.messages import CellReference


def cell(name: str, *sizes: float) -> Cell:
    bodies = tuple(
        PlacedMesh(f"body{i}", box_mesh(f"body{i}", (size, size, size)), np.eye(4)) for i, size in enumerate(sizes)
    )
    return Cell(name, np.zeros(3), np.ones(3), bodies)


class FakeMaster:
    """A master with one cell. It records the requests."""

    def __init__(self, watched: Cell) -> None:
        self.document, self.meshes = watched.to_document()
        self.reference = CellReference(name=watched.name, sha256=watched.version)
        self.requests: list[str] = []

    async def cell_document(self) -> dict[str, Any]:
        self.requests.append("cell")
        return self.document

    async def mesh(self, sha256: str) -> bytes:
        self.requests.append(sha256)
        return self.meshes[sha256]


async def get(cache: CellCache, master: Any) -> Cell:
    return await cache.get(master.reference, master)


async def fetch(folder: Path, master: FakeMaster) -> Cell:
    return await get(CellCache(folder), master)


async def test_a_cell_is_fetched_once(tmp_path: Path) -> None:
    watched = await asyncio.to_thread(cell, "one", 0.1, 0.2)
    master = FakeMaster(watched)
    assert (await fetch(tmp_path / "cell", master)).version == watched.version
    assert sorted(master.requests) == sorted(["cell", *master.meshes])
    master.requests.clear()
    assert (await fetch(tmp_path / "cell", master)).version == watched.version
    assert master.requests == []


async def test_a_cell_that_did_not_change_is_the_same_object(tmp_path: Path) -> None:
    master = FakeMaster(await asyncio.to_thread(cell, "one", 0.1))
    cache = CellCache(tmp_path)
    first = await get(cache, master)
    assert await get(cache, master) is first


async def test_only_the_new_parts_of_a_changed_cell_are_fetched_and_old_files_removed(tmp_path: Path) -> None:
    old = FakeMaster(await asyncio.to_thread(cell, "one", 0.1, 0.2))
    new = FakeMaster(await asyncio.to_thread(cell, "one", 0.1, 0.3))
    await fetch(tmp_path, old)
    await fetch(tmp_path, new)
    assert len(new.requests) == 2
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept == {f"{new.reference.sha256}.json", *(f"{sha256}.mesh" for sha256 in new.meshes)}


async def test_a_damaged_file_is_fetched_again(tmp_path: Path) -> None:
    master = FakeMaster(await asyncio.to_thread(cell, "one", 0.1))
    await fetch(tmp_path, master)
    document = tmp_path / f"{master.reference.sha256}.json"
    document.write_bytes(document.read_bytes().replace(b"one", b"two"))
    with pytest.raises(WireError, match="expected version"):
        await fetch(tmp_path, master)
    assert (await fetch(tmp_path, master)).name == "one"
    mesh = next(tmp_path.glob("*.mesh"))
    mesh.write_bytes(b"nothing")
    with pytest.raises(CellwatchError):
        await fetch(tmp_path, master)
    assert (await fetch(tmp_path, master)).name == "one"


async def test_a_cell_of_another_version_is_refused(tmp_path: Path) -> None:
    master = FakeMaster(await asyncio.to_thread(cell, "one", 0.1))
    master.document = {**master.document, "name": "two"}
    with pytest.raises(WireError, match="expected version"):
        await fetch(tmp_path, master)
    assert not list(tmp_path.glob("*.json"))


async def test_a_cell_is_used_without_a_writable_disk(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    await asyncio.to_thread((tmp_path / "file").write_text, "")
    master = FakeMaster(await asyncio.to_thread(cell, "one", 0.1))
    assert (await fetch(tmp_path / "file", master)).name == "one"
    assert "cannot be kept" in caplog.text
