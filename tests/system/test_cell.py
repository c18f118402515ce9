# SPDX-License-Identifier: Apache-2.0
"""The cell changes while real units watch it, as an integrator would change it: with a zip and with curl."""

from __future__ import annotations

import io
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
import yaml

from shared.transforms import from_xyz_rpy
from tests.system.cluster import Cluster, until, write_cell, write_recording

LOOKING_ALONG_Y = {"xyz": [1.0, -1.0, 1.0], "rpy_deg": [-90.0, 0.0, 0.0]}
LOOKING_ALONG_X = {"xyz": [-1.0, 1.0, 1.0], "rpy_deg": [-90.0, 0.0, -90.0]}

# The recorded patch of half a metre stands 1.5 m before each camera: at y = 0.5 m, and at x = 0.5 m.
BOARD_M = [0.7, 0.1, 0.7]
BOARD_BEHIND_THE_PATCH = {"xyz": [1.0, 0.55, 1.0]}
CORNER_M = [1.8, 1.8, 0.5]


def cell_of(top_m: float, board_xyz: list[float]) -> dict[str, Any]:
    """Return a box with a movable board, and a crate whose mesh is a file."""
    return {
        "name": "changed",
        "box": {"min": [0.0, 0.0, 0.0], "max": [2.0, 2.0, top_m]},
        "static": [{"name": "crate", "mesh": "cad/crate.obj", "pose": {"xyz": [1.7, 1.7, 0.1]}}],
        "objects": [{"name": "board", "box": BOARD_M, "pose": {"xyz": board_xyz}}],
    }


CRATE = "v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nv 0 0 0.2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def zipped(cell: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mycell/cell.yaml", yaml.safe_dump(cell))
        archive.writestr("mycell/cad/crate.obj", CRATE)
    return buffer.getvalue()


class Watcher(threading.Thread):
    """Polls the map all the time, and records each complete one."""

    def __init__(self, cluster: Cluster) -> None:
        super().__init__()
        self._url = cluster.url
        self._headers = dict(cluster.operator.headers)
        self._ended = threading.Event()
        self.complete: list[tuple[int, tuple[int, ...], int]] = []
        self.asked = 0

    def run(self) -> None:
        with httpx.Client(base_url=self._url, headers=self._headers, trust_env=False) as client:
            while not self._ended.is_set():
                view = client.get("/voxels").json()
                self.asked += 1
                if view["complete"]:
                    said = (view["lattice_version"], tuple(view["lattice"]["shape"]), len(view["voxels"]))
                    if not self.complete or self.complete[-1] != said:
                        self.complete.append(said)

    def __enter__(self) -> Watcher:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self.join()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        folder = write_recording(tmp_path / "recording")
        cluster.start_master()
        source = {"kind": "recorded", "folder": str(folder), "fps": 15.0, "loop": True}
        cluster.start_unit(1, {**source, "serial": "ONE"}, T_world_camera=LOOKING_ALONG_Y)
        cluster.start_unit(2, {**source, "serial": "TWO"}, T_world_camera=LOOKING_ALONG_X)
        cluster.until_live(2, 60.0)
        yield cluster


def put_zip(cluster: Cluster, cell: dict[str, Any]) -> Any:
    response = cluster.operator.put(
        "/cell", content=zipped(cell), headers={"Content-Type": "application/zip"}, timeout=60.0
    )
    assert response.status_code == 200, response.text
    return response.json()


def seen_of_patches(cluster: Cluster) -> tuple[int, int]:
    """Return the numbers of voxels before the first and the second camera."""
    centres = cluster.get("/voxels?form=centres")["voxels"]
    first = [c for c in centres if abs(c[1] - 0.5) < 0.06 and abs(c[0] - 1.0) < 0.3]
    second = [c for c in centres if abs(c[0] - 0.5) < 0.06 and abs(c[1] - 1.0) < 0.3]
    assert len(first) + len(second) == len(centres)
    return len(first), len(second)


def complete(cluster: Cluster) -> Any:
    return until(lambda: (view := cluster.get("/voxels"))["complete"] and view, "a complete map", 10.0)


@pytest.mark.slow
def test_a_cell_in_a_zip_and_an_object_that_moves_reach_running_units(cluster: Cluster) -> None:
    before = complete(cluster)
    assert min(seen_of_patches(cluster)) >= 80
    with Watcher(cluster) as watcher:
        answer = put_zip(cluster, cell_of(1.6, CORNER_M))
        after = complete(cluster)
        assert (answer["versions"]["cell"], answer["versions"]["lattice"]) == (2, before["lattice_version"] + 1)
        assert after["lattice"]["shape"] == [40, 40, 32]
        assert min(seen_of_patches(cluster)) >= 80

        # The board stood before the first camera. Once it is known it is no obstacle.
        pose = from_xyz_rpy(BOARD_BEHIND_THE_PATCH["xyz"], (0.0, 0.0, 0.0)).tolist()
        moved = cluster.put("/cell/objects/board/pose", {"T_world_object": pose})
        assert (moved["versions"]["cell"], moved["versions"]["lattice"]) == (3, answer["versions"]["lattice"])
        complete(cluster)
        first, second = seen_of_patches(cluster)
        assert first == 0
        assert second >= 80
        assert [row["versions"]["cell"] for row in cluster.get("/units")] == [3, 3]

        # An invalid cell changes nothing.
        wrong = zipped({**cell_of(1.6, CORNER_M), "objekts": []})
        refused = cluster.operator.put("/cell", content=wrong, headers={"Content-Type": "application/zip"})
        assert refused.status_code == 422
        assert "objekts" in refused.json()["detail"]
        assert len(complete(cluster)["voxels"]) == first + second
        assert [row["versions"]["cell"] for row in cluster.get("/units")] == [3, 3]
    whole = first + second
    numbers = [(version, shape) for version, shape, _ in watcher.complete]
    assert watcher.asked > 10
    # Each lattice by itself, one after the other, and never only some of the voxels.
    assert numbers == sorted(numbers)
    assert set(numbers) == {(before["lattice_version"], (40, 40, 40)), (after["lattice_version"], (40, 40, 32))}
    assert {count for _, _, count in watcher.complete} == {len(before["voxels"]), len(after["voxels"]), whole}
    for number in (1, 2):
        assert "Traceback" not in cluster.log(f"unit{number}")
    assert "Traceback" not in cluster.log("master")


@pytest.mark.slow
def test_pictures_by_curl(cluster: Cluster) -> None:
    row = cluster.get("/units")[0]
    path = f"/units/{row['id']}/images"
    for kind in ("depth", "expected", "foreground"):
        response = cluster.operator.get(f"{path}/{kind}", timeout=10.0)
        assert response.status_code == 200, response.text
        assert response.headers["x-depth-range-m"] == "0.3 6"
        image = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_UNCHANGED)
        assert image.shape == (120, 160, 3)
    raw = cluster.operator.get(f"{path}/depth?raw=1", timeout=10.0)
    image = cv2.imdecode(np.frombuffer(raw.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(image).tolist()) == {1500, 5000}
    assert cluster.operator.get("/units/99/images/depth").status_code == 404
    cluster.until_live(2)
