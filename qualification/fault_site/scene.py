# SPDX-License-Identifier: Apache-2.0
"""Scene of the fault table: the view of its two cameras, and the blocks of the cell that its things fill.

Two cameras side by side look along +y through a flat cell. Their views do not overlap, so nobody else sees the view of
either camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

WIDTH, HEIGHT, FOCAL_PX = 160, 120, 300.0
"""Small images and a narrow view, because two units, a master and the observers share two cores."""

FPS = 15.0

IMAGE = "scene.npy"

BOX_MIN_M, BOX_MAX_M = (0.0, 0.0, 0.2), (2.1, 0.6, 0.8)

CAMERAS_M = ((0.55, -1.5, 0.5), (1.55, -1.5, 0.5))

RPY_DEG = (-90.0, 0.0, 0.0)
"""Orientation of a camera that looks along +y."""

T_WORLD_CAMERA = tuple(
    ((1.0, 0.0, 0.0, x), (0.0, 0.0, 1.0, y), (0.0, -1.0, 0.0, z), (0.0, 0.0, 0.0, 1.0)) for x, y, z in CAMERAS_M
)

WALL_MM = 5000
"""Depth of the wall behind the cell. It is in no CAD."""

THING_MM = 1775
"""Depth of a thing, in the middle of a voxel."""

CELL: dict[str, Any] = {
    "name": "faults",
    "box": {"min": list(BOX_MIN_M), "max": list(BOX_MAX_M)},
    # The robot stands behind the wall. The cell only has to have one, which reports its joints.
    "robot": {
        "dh": {"joints": [{"link": {"box": [0.1, 0.1, 0.1]}}, *({} for _ in range(5))]},
        "pose": {"xyz": [1.0, 8.0, 0.0]},
    },
}


@dataclass(frozen=True)
class Thing:
    """A flat thing that no model contains, as pixels of one camera."""

    name: str
    camera: int
    columns: tuple[int, int]
    rows: tuple[int, int] = (30, 90)

    def blocks(self, origin_m: NDArray[np.float64], size_m: float) -> NDArray[np.int64]:
        """Return the indices (N, 3) of the blocks that it crosses from edge to edge. Blocks that it only touches do not
        count.
        """
        x, y, z = CAMERAS_M[self.camera]
        left, right = (x + (column - 0.5 - (WIDTH - 1) / 2) * THING_MM / 1000 / FOCAL_PX for column in self.columns)
        top, bottom = (z - (row - 0.5 - (HEIGHT - 1) / 2) * THING_MM / 1000 / FOCAL_PX for row in self.rows)
        first = np.ceil((np.array([left, bottom]) - origin_m[[0, 2]]) / size_m).astype(np.int64)
        end = np.floor((np.array([right, top]) - origin_m[[0, 2]]) / size_m).astype(np.int64)
        depth = int((y + THING_MM / 1000 - origin_m[1]) // size_m)
        return np.array([(i, depth, k) for i in range(first[0], end[0]) for k in range(first[1], end[1])])


RESIDENTS = (Thing("resident of camera 1", 0, (15, 65)), Thing("resident of camera 2", 1, (15, 65)))
"""Things that stand in the cell from the beginning."""

NEWCOMER = Thing("newcomer", 0, (95, 145))
"""Appears immediately after the cause of each fault, in the view of only the affected unit."""


def write_cell(folder: Path) -> Path:
    """Write the cell's file and return its path."""
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(CELL))
    return path


def write_camera(folder: Path, camera: int) -> Path:
    """Write the image folder of one camera, with its resident, and return its path."""
    folder.mkdir()
    k = [FOCAL_PX, 0.0, (WIDTH - 1) / 2, 0.0, FOCAL_PX, (HEIGHT - 1) / 2, 0.0, 0.0, 1.0]
    (folder / "camera_info.yaml").write_text(yaml.safe_dump({"width": WIDTH, "height": HEIGHT, "k": k}))
    show(folder, RESIDENTS[camera])
    return folder


def show(folder: Path, *things: Thing) -> None:
    """Show exactly these things to the camera of this folder, from the next frame on."""
    depth = np.full((HEIGHT, WIDTH), WALL_MM, np.uint16)
    for thing in things:
        depth[slice(*thing.rows), slice(*thing.columns)] = THING_MM
    written = folder / "scene.new"
    with written.open("wb") as file:
        np.save(file, depth)
    written.rename(folder / IMAGE)
