# SPDX-License-Identifier: Apache-2.0
"""What stands before the two cameras of the fault table, and which blocks of the cell it fills.

Two cameras side by side look along +y through a flat cell; their views do not overlap, so what one of them shows
nobody else can see.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

WIDTH, HEIGHT, FOCAL_PX = 160, 120, 300.0
"""Small and of a narrow view: two units, a master and whoever watches them share two cores."""

FPS = 15.0

IMAGE = "scene.npy"

BOX_MIN_M, BOX_MAX_M = (0.0, 0.0, 0.2), (2.1, 0.6, 0.8)

CAMERAS_M = ((0.55, -1.5, 0.5), (1.55, -1.5, 0.5))

RPY_DEG = (-90.0, 0.0, 0.0)
"""Looking along +y."""

T_WORLD_CAMERA = tuple(
    ((1.0, 0.0, 0.0, x), (0.0, 0.0, 1.0, y), (0.0, -1.0, 0.0, z), (0.0, 0.0, 0.0, 1.0)) for x, y, z in CAMERAS_M
)

WALL_MM = 5000
"""Behind the cell, and in no CAD."""

THING_MM = 1775
"""In the middle of a voxel."""

CELL: dict[str, Any] = {
    "name": "faults",
    "box": {"min": list(BOX_MIN_M), "max": list(BOX_MAX_M)},
    # It stands behind the wall: what counts is that the cell has one, and that it reports.
    "robot": {
        "dh": {"joints": [{"link": {"box": [0.1, 0.1, 0.1]}}, *({} for _ in range(5))]},
        "pose": {"xyz": [1.0, 8.0, 0.0]},
    },
}


@dataclass(frozen=True)
class Thing:
    """A flat thing that no model knows, as pixels of one camera."""

    name: str
    camera: int
    columns: tuple[int, int]
    rows: tuple[int, int] = (30, 90)

    def blocks(self, origin_m: NDArray[np.float64], size_m: float) -> NDArray[np.int64]:
        """Indices (N, 3) of the blocks that it crosses from edge to edge; those that it only touches do not count."""
        x, y, z = CAMERAS_M[self.camera]
        left, right = (x + (column - 0.5 - (WIDTH - 1) / 2) * THING_MM / 1000 / FOCAL_PX for column in self.columns)
        top, bottom = (z - (row - 0.5 - (HEIGHT - 1) / 2) * THING_MM / 1000 / FOCAL_PX for row in self.rows)
        first = np.ceil((np.array([left, bottom]) - origin_m[[0, 2]]) / size_m).astype(np.int64)
        end = np.floor((np.array([right, top]) - origin_m[[0, 2]]) / size_m).astype(np.int64)
        depth = int((y + THING_MM / 1000 - origin_m[1]) // size_m)
        return np.array([(i, depth, k) for i in range(first[0], end[0]) for k in range(first[1], end[1])])


RESIDENTS = (Thing("resident of camera 1", 0, (15, 65)), Thing("resident of camera 2", 1, (15, 65)))
"""There from the beginning."""

NEWCOMER = Thing("newcomer", 0, (95, 145))
"""Comes right behind the cause of each fault, where only the unit in trouble could have seen it."""


def write_cell(folder: Path) -> Path:
    """The cell's file."""
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(CELL))
    return path


def write_camera(folder: Path, camera: int) -> Path:
    """A folder in which the picture of one camera lies, with its resident."""
    folder.mkdir()
    k = [FOCAL_PX, 0.0, (WIDTH - 1) / 2, 0.0, FOCAL_PX, (HEIGHT - 1) / 2, 0.0, 0.0, 1.0]
    (folder / "camera_info.yaml").write_text(yaml.safe_dump({"width": WIDTH, "height": HEIGHT, "k": k}))
    show(folder, RESIDENTS[camera])
    return folder


def show(folder: Path, *things: Thing) -> None:
    """From the next frame on the camera of this folder sees these, and nothing else."""
    depth = np.full((HEIGHT, WIDTH), WALL_MM, np.uint16)
    for thing in things:
        depth[slice(*thing.rows), slice(*thing.columns)] = THING_MM
    written = folder / "scene.new"
    with written.open("wb") as file:
        np.save(file, depth)
    written.rename(folder / IMAGE)
