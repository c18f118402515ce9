# SPDX-License-Identifier: Apache-2.0
"""Scene of the speed test: a UR3 in a room of known walls, something unknown beside it, a D435i before them.

Embree casts a ray for each pixel, and the faults of the camera are added. So neither the filter nor a peer measures
what it has drawn itself.
"""

from __future__ import annotations

import sysconfig
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.cell import Cell, PlacedMesh
from shared.errors import CellwatchError
from shared.kinematics import Robot
from shared.meshes import TriangleMesh, box_mesh
from shared.settings import FilterSettings
from shared.transforms import Transform, from_xyz_rpy, look_at
from simulation.cameras.camera import d435i_intrinsics
from simulation.cameras.depth_noise import DepthNoise, DepthSensor
from simulation.cameras.raycast import RaycastRenderer
from simulation.world.scene import Body, Capsules, Owner, Scene

UR3 = Path("cmeel.prefix/share/example-robot-data/robots/ur_description/urdf/ur3_robot.urdf")
"""Path in the wheel of example-robot-data. The collision meshes have 37,476 triangles."""

T_WORLD_CAMERA = look_at((1.0, 0.45, 0.85), (0.05, -0.05, 0.2))

LOW_M, HIGH_M = np.array((-1.6, -1.6, -0.9)), np.array((1.6, 1.6, 1.5))
"""Box that contains everything that the camera can see."""

WALL_M = 1.5
"""Distance of the walls from the robot."""

HOME_RAD = np.array((0.3, -1.2, 1.3, -1.5, -1.5, 0.0))
SWING_RAD = 0.6

FOREGROUND_SHARE = 0.1
STRANGER_AXES_M = np.array((0.2, 0.25, 0.5))
"""Half axes of the ellipsoid that represents a person, before it is scaled to `FOREGROUND_SHARE` of the image."""

T_WORLD_STRANGER = from_xyz_rpy((0.05, -0.85, 0.1), (0.0, 0.0, 0.4))

BISECTIONS = 10


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames of one camera in one cell.

    Attributes:
        depth: (N, H, W) uint16.
        joints: (N, 6) rad, each frame's.
        unhindered: (N, H, W) uint16, the same with every pixel measured: all foreground in an empty cell.
    """

    intrinsics: Intrinsics
    cell: Cell
    depth: NDArray[np.uint16]
    joints: NDArray[np.float64]
    unhindered: NDArray[np.uint16]

    @property
    def T_world_camera(self) -> Transform:
        """Return the camera's pose."""
        return T_WORLD_CAMERA

    def pipeline(self, voxel_size_m: float) -> DepthPipeline:
        """Return the filter of this camera."""
        return DepthPipeline(self.intrinsics, T_WORLD_CAMERA, self.cell, FilterSettings(voxel_size_m=voxel_size_m))

    def pipeline_that_knows_nothing(self, voxel_size_m: float) -> DepthPipeline:
        """Return the filter of this camera in an empty cell, in which every measured pixel is foreground."""
        empty = Cell("nothing is known", LOW_M, HIGH_M)
        return DepthPipeline(self.intrinsics, T_WORLD_CAMERA, empty, FilterSettings(voxel_size_m=voxel_size_m))


def ur3() -> Robot:
    """Return the UR3 of example-robot-data.

    Raises:
        CellwatchError: the package is not installed.
    """
    path = Path(sysconfig.get_path("purelib")) / UR3
    if not path.is_file():
        raise CellwatchError(f"{path}: no such file; install example-robot-data, which the benchmarks need")
    return Robot.from_urdf(path)


def room() -> Cell:
    """Return the cell: floor, table, three walls and the UR3."""
    thick_m = 0.05
    span_m = 2.0 * (WALL_M + thick_m)
    size = {
        "table": (1.2, 1.0, 0.04),
        "floor": (span_m, span_m, thick_m),
        "behind": (thick_m, span_m, 2.3),
        "left": (span_m, thick_m, 2.3),
        "right": (span_m, thick_m, 2.3),
    }
    at = {
        "table": (0.1, 0.0, -0.02),
        "floor": (0.0, 0.0, -0.85),
        "behind": (-WALL_M - 0.5 * thick_m, 0.0, 0.3),
        "left": (0.0, -WALL_M - 0.5 * thick_m, 0.3),
        "right": (0.0, WALL_M + 0.5 * thick_m, 0.3),
    }
    static = tuple(PlacedMesh(name, box_mesh(name, size[name]), from_xyz_rpy(at[name], (0, 0, 0))) for name in size)
    return Cell("UR3", LOW_M, HIGH_M, static, robot=ur3())


def record(width: int, height: int, frames: int, seed: int = 0) -> Recording:
    """Render `frames` frames with different joints. `FOREGROUND_SHARE` of the first one's pixels are foreground."""
    intrinsics, cell = d435i_intrinsics(width, height), room()
    renderer = RaycastRenderer(intrinsics, T_WORLD_CAMERA)
    sensor = DepthSensor(intrinsics, DepthNoise(), seed)
    perfect = DepthNoise(hole_share=0.0, shadow=False, grazing_from_deg=90.0, range_max_m=0.0, disparity_max_px=0.0)
    unhindered = DepthSensor(intrinsics, perfect, seed)
    ball = trimesh.creation.icosphere(4)
    joints = HOME_RAD + np.random.default_rng(seed).uniform(-SWING_RAD, SWING_RAD, (frames, len(HOME_RAD)))
    fixed = tuple(Body(each.name, each.mesh, each.T_world_mesh, Owner.STATIC) for each in cell.static)

    def look(n: int, scale: float) -> NDArray[np.float32]:
        assert cell.robot is not None
        poses = cell.robot.T_world_base @ cell.robot.link_poses(joints[n])
        links = [Body(link.name, link.mesh, poses[k], Owner.ROBOT) for k, link in enumerate(cell.robot.links)]
        mesh = TriangleMesh("stranger", ball.vertices * (scale * STRANGER_AXES_M), ball.faces, closed=True)
        stranger = Body("stranger", mesh, T_WORLD_STRANGER, Owner.PERSON)
        return renderer.render(Scene(fixed, (*links, stranger), Capsules.joined([]))).z_m

    pipeline = DepthPipeline(intrinsics, T_WORLD_CAMERA, cell)
    small, large = 0.1, 2.0
    for _ in range(BISECTIONS):
        scale = 0.5 * (small + large)
        share = pipeline.foreground(sensor.measure(look(0, scale), 0), joints[0]).mean()
        small, large = (scale, large) if share < FOREGROUND_SHARE else (small, scale)
    seen = [look(n, scale) for n in range(frames)]
    return Recording(
        intrinsics,
        cell,
        np.stack([sensor.measure(z_m, n) for n, z_m in enumerate(seen)]),
        joints,
        np.stack([unhindered.measure(z_m, n) for n, z_m in enumerate(seen)]),
    )
