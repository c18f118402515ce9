# SPDX-License-Identifier: Apache-2.0
"""Hulls on disk: equal to new ones, complete or absent, bounded, and never a cause of failure of a unit."""

from __future__ import annotations

import errno
import logging
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from geometry.compilation.cache import folder_beside
from geometry.rendering import hull_around, hull_store, padded_hull
from geometry.rendering.hull_store import HullStore, state_of_code
from shared.meshes import TriangleMesh, box_mesh, sphere_mesh

HULL_M = 0.05


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "hulls"


@pytest.fixture
def made(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the names of the meshes whose hulls are made, in `folder`; each `start` is a start of a unit."""
    names: list[str] = []
    make = padded_hull.make_hull

    def spy(mesh: TriangleMesh, distance_m: float) -> TriangleMesh:
        names.append(mesh.name)
        return make(mesh, distance_m)

    monkeypatch.setattr(padded_hull, "make_hull", spy)
    start(monkeypatch, folder)
    return names


def start(monkeypatch: pytest.MonkeyPatch, folder: Path, code_state: str = "1") -> None:
    store = HullStore(folder, code_state)
    monkeypatch.setattr(padded_hull, "_hulls", {})
    monkeypatch.setattr(padded_hull, "_store", lambda: store)


def same(one: TriangleMesh, other: TriangleMesh) -> bool:
    return one.to_bytes() == other.to_bytes()


def test_the_second_start_loads_the_hulls_of_the_first(
    folder: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = hull_around(sphere_mesh("ball", 0.2), HULL_M)
    assert made == ["ball"]
    start(monkeypatch, folder)
    second = hull_around(sphere_mesh("the same ball", 0.2), HULL_M)
    assert made == ["ball"]
    assert same(second, first)
    assert second.name == "the same ball"
    assert second.closed


def test_another_mesh_distance_or_code_has_another_hull(
    folder: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = box_mesh("box", (0.1, 0.1, 0.1))
    hull_around(mesh, HULL_M)
    hull_around(mesh, 0.04)
    hull_around(box_mesh("other", (0.1, 0.1, 0.2)), HULL_M)
    assert made == ["box", "box", "other"]
    start(monkeypatch, folder, "2")
    hull_around(mesh, HULL_M)
    assert made == ["box", "box", "other", "box"]


@pytest.mark.parametrize("damage", ["empty", "cut", "bit", "other's", "no mesh"])
def test_a_damaged_file_is_removed_and_made_again(
    folder: Path, made: list[str], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    mesh = box_mesh("box", (0.1, 0.1, 0.1))
    first = hull_around(mesh, HULL_M)
    (file,) = folder.iterdir()
    content = file.read_bytes()
    if damage == "other's":
        hull_around(box_mesh("other", (0.2, 0.1, 0.1)), HULL_M)
        (other,) = set(folder.iterdir()) - {file}
        file.write_bytes(other.read_bytes())
    elif damage == "no mesh":
        file.write_bytes(hull_store._digest(file, b"text") + b"text")
    else:
        flipped = content[:-9] + bytes([content[-9] ^ 1]) + content[-8:]
        file.write_bytes({"empty": b"", "cut": content[:-5], "bit": flipped}[damage])
    made.clear()
    start(monkeypatch, folder)
    assert same(hull_around(mesh, HULL_M), first)
    assert made == ["box"]
    assert f"{file}: damaged, so the hull of box is made again" in caplog.text
    assert file.read_bytes() == content


def test_the_least_recently_used_hulls_are_removed_first(
    folder: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    meshes = [box_mesh(f"box {number}", (0.1, 0.1, 0.1 + 0.1 * number)) for number in range(4)]
    monkeypatch.setattr(hull_store, "FILES_MAX", 3)
    for number, mesh in enumerate(meshes[:3]):
        known = set(folder.iterdir()) if folder.exists() else set()
        hull_around(mesh, HULL_M)
        (file,) = set(folder.iterdir()) - known
        os.utime(file, (number, number))
    start(monkeypatch, folder)
    hull_around(meshes[0], HULL_M)
    hull_around(meshes[3], HULL_M)
    assert len(list(folder.iterdir())) == 3
    made.clear()
    start(monkeypatch, folder)
    for mesh in (meshes[0], meshes[2], meshes[3]):
        hull_around(mesh, HULL_M)
    assert made == []
    hull_around(meshes[1], HULL_M)
    assert made == ["box 1"]


def test_their_bytes_are_bounded_too(folder: Path, made: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    hull_around(box_mesh("box", (0.1, 0.1, 0.1)), HULL_M)
    size = sum(file.stat().st_size for file in folder.iterdir())
    monkeypatch.setattr(hull_store, "BYTES_MAX", 3 * size)
    (folder / "left behind.partial").write_bytes(bytes(size))
    for number in range(1, 6):
        hull_around(box_mesh("box", (0.1, 0.1, 0.1 + 0.01 * number)), HULL_M)
        assert sum(file.stat().st_size for file in folder.iterdir()) <= 3 * size
    monkeypatch.setattr(hull_store, "BYTES_MAX", size // 2)
    files = set(folder.iterdir())
    hull_around(box_mesh("box", (0.3, 0.1, 0.1)), HULL_M)
    assert set(folder.iterdir()) == files


def test_a_full_disk_is_a_warning_once(
    folder: Path, made: list[str], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(path: Path, content: bytes, **how: bool) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(hull_store, "write_whole", full)
    for size_m in (0.1, 0.2):
        assert hull_around(box_mesh("box", (0.1, 0.1, size_m)), HULL_M).closed
    assert made == ["box", "box"]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert str(folder) in record.getMessage()
    assert "No space left on device" in record.getMessage()


def test_a_folder_that_cannot_be_made_is_a_warning_once(
    folder: Path, made: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    folder.write_text("a file is in the way")
    for size_m in (0.1, 0.2):
        assert hull_around(box_mesh("box", (0.1, 0.1, size_m)), HULL_M).closed
    assert made == ["box", "box"]
    assert len(caplog.records) == 1


def test_the_state_of_the_code_distinguishes_sources_and_libraries(tmp_path: Path) -> None:
    one, other = tmp_path / "one.py", tmp_path / "other.py"
    one.write_text("a = 1")
    other.write_text("b = 1")
    states = {
        state_of_code((one,), ("library 1",)),
        state_of_code((one,), ("library 2",)),
        state_of_code((other,), ("library 1",)),
        state_of_code((one, other), ("library 1",)),
        state_of_code((one, other), ()),
    }
    assert len(states) == 5
    assert state_of_code((one,), ("library 1",)) in states


def test_hulls_are_stored_beside_the_kernels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels-0123456789ab"))
    assert folder_beside("hulls") == tmp_path / "hulls"


def test_units_that_start_together_do_not_disturb_one_another(folder: Path) -> None:
    """Each unit writes all hulls; no write fails because of another, and in the end all files are complete."""
    keep = """
import logging, sys
from pathlib import Path
from geometry.rendering.hull_store import HullStore
from shared.meshes import box_mesh
logging.basicConfig(format="%(message)s")
store = HullStore(Path(sys.argv[1]), "state")
print("ready", flush=True)
sys.stdin.readline()
for number in range(150):
    mesh = box_mesh("box", (0.1, 0.1, 0.1 + 0.001 * number))
    store.save(mesh, 0.05, mesh)
"""
    with ExitStack() as stack:
        units = [
            stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", keep, str(folder)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )
            for _ in range(3)
        ]
        for unit in units:
            assert unit.stdout is not None
            assert unit.stdout.readline() == "ready\n"
        # communicate() would let the first start alone.
        for unit in units:
            assert unit.stdin is not None
            unit.stdin.write("go\n")
            unit.stdin.flush()
        said = [unit.communicate(timeout=60.0)[1] for unit in units]
    assert said == ["", "", ""]
    store = hull_store.HullStore(folder, "state")
    assert all(store.load(box_mesh("box", (0.1, 0.1, 0.1 + 0.001 * number)), 0.05) for number in range(150))
    assert not list(folder.glob("*.partial"))
