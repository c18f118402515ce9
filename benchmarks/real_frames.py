# SPDX-License-Identifier: Apache-2.0
"""The real recordings in `xarm7_realsense`, and their ground truth.

A RealSense looks at an xArm7. In frames 0 to 3 a second robot stands in the image, which no model contains; in frames 4
to 9 it is gone. Its place and the pixels of the xArm7 are known.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline import DepthPipeline, Voxels
from shared.cell import Cell
from shared.errors import SourceError
from shared.lattice import Lattice
from shared.settings import FilterSettings

NAME = "xarm7_realsense"
EMPTY_FRAMES = (4, 5, 6, 7, 8, 9)
WATCHED_FRAMES = (0, 1, 2, 3)

STEREO_FOCAL_PX = 430.0
"""Depth comes in steps of 9.3 mm at 2.55 m; at 1/32 px and 50 mm baseline that is a D435 at 848x480, its best
profile. The recording was then aligned to the colour camera's 908 px."""

CELL = Path(__file__).parent.parent / "assets" / "cells" / "xarm7" / "cell.yaml"

SECOND_ROBOT_PIXELS = (325, 490, 285, 600)
"""First and last column, first and last row of the second robot's pixels. Its depth is 1.45 to 1.85 m."""

SECOND_ROBOT_VOXELS = (315, 500, 275, 610)
"""The same for the centres of its voxels, one voxel wider, 1.4 to 1.9 m."""


def find() -> Path:
    """Return the folder of the recordings.

    Raises:
        SourceError: the folder is not there; the text names the places that were searched.
    """
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    named = os.environ.get("CELLWATCH_DATA")
    tried = [Path(named)] if named else [beside]
    for folder in tried:
        if (folder / NAME).is_dir():
            return folder / NAME
    places = " nor ".join(str(folder / NAME) for folder in tried)
    raise SourceError(
        f"the real recordings are not there: no {places}; set CELLWATCH_DATA to the folder that holds them"
    )


@dataclass(frozen=True)
class FrameMarks:
    """Figures of one watched frame."""

    robot_leak_percent: float
    second_robot_miss_percent: float
    second_robot_voxels: int
    false_voxels: int


@dataclass(frozen=True, eq=False)
class RealFrames:
    """The recordings.

    `depth` (10, H, W) uint16 mm, `colour` (10, H, W, 3), `robot_mask` (10, H, W), `joints` (10, 7) rad, and a pipeline
    that has learned the empty frames.
    """

    pipeline: DepthPipeline
    depth: NDArray[np.uint16]
    colour: NDArray[np.uint8]
    robot_mask: NDArray[np.bool_]
    joints: NDArray[np.float64]

    def marks(self, frame: int, voxels: Voxels | NDArray[np.uint32]) -> FrameMarks:
        """Judge our filter on a watched frame, and the voxels that were reported of it."""
        keys = voxels.keys if isinstance(voxels, Voxels) else voxels
        return self.judge(frame, self.pipeline.foreground(self.depth[frame], self.joints[frame]), keys)

    def judge(self, frame: int, survives: NDArray[np.bool_], keys: NDArray[np.uint32]) -> FrameMarks:
        """Judge any filter by the pixels (H, W) that survive it and by the voxels (N,) that it reports.

        Without a second robot nothing of it can be missed: 0 %.
        """
        depth = self.depth[frame]
        robot = self.robot_mask[frame] & (depth > 0)
        second = self._second_robot(frame)
        u, v, z = self.project(keys)
        first_u, last_u, first_v, last_v = SECOND_ROBOT_VOXELS
        is_second = (u >= first_u) & (u <= last_u) & (v >= first_v) & (v <= last_v) & (z >= 1.4) & (z <= 1.9)
        is_laptop = (u < 250) & (v > 400)
        return FrameMarks(
            robot_leak_percent=100.0 * float(survives[robot].mean()),
            second_robot_miss_percent=100.0 * float((~survives[second]).mean()) if second.any() else 0.0,
            second_robot_voxels=int(is_second.sum()),
            false_voxels=int((~is_second & ~is_laptop).sum()),
        )

    def project(self, keys: NDArray[np.uint32]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return column and row (N,) in px and depth (N,) in m of the centres of voxels."""
        lattice: Lattice = self.pipeline.lattice
        T_world_camera = self.pipeline.T_world_camera
        centres_m = lattice.centres(lattice.indices(keys))
        points_camera_m = (centres_m - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        u, v = np.moveaxis(self.pipeline.intrinsics.project(points_camera_m), -1, 0)
        return u, v, points_camera_m[:, 2]

    def _second_robot(self, frame: int) -> NDArray[np.bool_]:
        """Return the pixels (H, W) of the second robot."""
        first_u, last_u, first_v, last_v = SECOND_ROBOT_PIXELS
        depth = self.depth[frame]
        found = (depth >= 1450) & (depth <= 1850) & ~self.robot_mask[frame]
        window = np.zeros_like(found)
        window[first_v : last_v + 1, first_u : last_u + 1] = True
        return np.asarray(found & window)


def load(folder: Path, pipeline: DepthPipeline) -> RealFrames:
    """Read all frames, and let `pipeline` learn the empty ones.

    Raises:
        SourceError: a file is missing.
    """
    frames = range(len(EMPTY_FRAMES) + len(WATCHED_FRAMES))
    depth = np.stack([_image(folder / "depth" / f"{frame:02d}.png") for frame in frames])
    colour = np.stack([_image(folder / "color" / f"{frame:02d}.png") for frame in frames])
    robot_mask = np.stack([_image(folder / "mask" / f"{frame:02d}.png", cv2.IMREAD_GRAYSCALE) > 0 for frame in frames])
    joints = np.loadtxt(folder / "joint_states_rad.csv", delimiter=",")
    pipeline.use(pipeline.learn((depth[frame], joints[frame]) for frame in EMPTY_FRAMES))
    return RealFrames(pipeline, depth, colour[..., :3], robot_mask, joints)


def cell(folder: Path) -> Cell:
    """Return the cell of the recordings, whose robot model is in the same folder."""
    os.environ["CELLWATCH_DATA"] = str(folder.parent)
    return Cell.load(CELL)


def default_settings() -> FilterSettings:
    """Return the default settings, the same for all frames."""
    return FilterSettings()


def _image(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise SourceError(f"{path}: no image")
    return np.asarray(image)
