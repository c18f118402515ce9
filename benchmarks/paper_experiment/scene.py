# SPDX-License-Identifier: Apache-2.0
"""The paper's cell: a UR3 that moves, a person beside it, four cameras around them.

The frames are rendered once, beforehand, and every contender gets the same ones. Embree casts a ray for each pixel, and
the faults of the camera are added.
"""

from __future__ import annotations

import math
import sysconfig
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from benchmarks.peers.ur3_scene import HOME_RAD, SWING_RAD, UR3, room
from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.settings import FilterSettings
from shared.transforms import Transform, look_at
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics
from simulation.world.people import Loop, Person
from simulation.world.robot_path import RobotPath
from simulation.world.world import World

CAMERAS = 4
CORNERS_M = ((1.4, 1.4, 1.3), (-1.4, -1.4, 1.3), (1.4, -1.4, 1.3), (-1.4, 1.4, 1.3))
"""Positions of the cameras in the room's corners, opposite ones first."""

LOOKED_AT_M = (0.3, 0.0, 0.1)

PERSON = Person(Loop((0.95, 0.0), 0.5 * math.pi, 0.5, 0.18), floor_m=-0.825, dwell_s=2.0)
"""Walks up and down before the table."""

FRAME_S = 0.37
"""Time between frames. It divides neither the period of a step nor that of the robot."""

ROBOT_PERIOD_S = 5.0


@dataclass(frozen=True, eq=False)
class Views:
    """Frames of all cameras at the same moments.

    Attributes:
        poses: `T_world_camera` of the cameras.
        depth: (CAMERAS, N, H, W) uint16.
        joints: (N, 6) rad at these moments; no two are the same.
    """

    intrinsics: Intrinsics
    cell: Cell
    poses: tuple[Transform, ...]
    depth: NDArray[np.uint16]
    joints: NDArray[np.float64]

    @property
    def name(self) -> str:
        """Return the resolution in words."""
        return f"{self.intrinsics.width}x{self.intrinsics.height}"

    @property
    def frames(self) -> int:
        """Return the number of moments."""
        return len(self.joints)

    def pipeline(self, camera: int, voxel_size_m: float) -> DepthPipeline:
        """Return the filter of one camera."""
        pose, settings = self.poses[camera], FilterSettings(voxel_size_m=voxel_size_m)
        return DepthPipeline(self.intrinsics, pose, self.cell, settings)

    def of_one(self, camera: int) -> Views:
        """Return the same moments, but with all cameras at the place of this one and with its frames."""
        # The arrays are copied, because kernels are compiled again for read-only arrays.
        depth = np.stack([self.depth[camera]] * CAMERAS)
        return replace(self, poses=(self.poses[camera],) * CAMERAS, depth=depth)


def world() -> World:
    """Return the cell with its moving robot and the person."""
    phases = np.linspace(0.0, 5.0, len(HOME_RAD))
    path = RobotPath(HOME_RAD, np.full((1, len(HOME_RAD)), SWING_RAD), phases[None], ROBOT_PERIOD_S)
    return World(room(), path, (PERSON,))


def views(width: int, height: int, frames: int) -> Views:
    """Render the frames of all cameras at `frames` moments.

    Raises:
        InputError: a D435i has no such resolution.
    """
    intrinsics, scene = d435i_intrinsics(width, height), world()
    poses = tuple(look_at(corner, LOOKED_AT_M) for corner in CORNERS_M)
    depth = np.empty((CAMERAS, frames, height, width), np.uint16)
    joints = np.empty((frames, len(HOME_RAD)))
    for index, pose in enumerate(poses):
        camera = SimulatedCamera(scene, pose, intrinsics, renderer="raycast", seed=index)
        for n in range(frames):
            frame = camera.capture(n * FRAME_S)
            assert frame.joints is not None
            depth[index, n], joints[n] = frame.depth, frame.joints
    return Views(intrinsics, scene.cell, poses, depth, joints)


def write_cell(cell: Cell, path: Path) -> None:
    """Write the cell as the file that a master starts with. Its static bodies are boxes along the axes."""
    static = []
    for body in cell.static:
        low, high = body.mesh.vertices.min(axis=0), body.mesh.vertices.max(axis=0)
        middle = body.T_world_mesh[:3, 3] + 0.5 * (low + high)
        static.append({"name": body.name, "box": (high - low).tolist(), "pose": {"xyz": middle.tolist()}})
    document = {
        "name": cell.name,
        "box": {"min": cell.box_min_m.tolist(), "max": cell.box_max_m.tolist()},
        "static": static,
        "robot": {"urdf": str(Path(sysconfig.get_path("purelib")) / UR3)},
    }
    path.write_text(yaml.safe_dump(document, sort_keys=False))
