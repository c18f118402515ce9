# SPDX-License-Identifier: Apache-2.0
"""One D435i with its faults, and things before it: a bare scene, with a ray cast by Embree for each pixel.

In `make sweeps` the camera looks straight down at a table: the world's z axis points at the camera, and the table's top
is at z = 0. `make bench-accuracy` has a wall, see `benchmarks.ground_truth.things`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline import DepthPipeline, Voxels
from shared.cell import Cell, PlacedMesh
from shared.meshes import box_mesh
from shared.settings import FilterSettings
from shared.transforms import Transform, apply, from_rotation_translation
from simulation.cameras.camera import SimulatedFrame, d435i_intrinsics
from simulation.cameras.depth_noise import DepthNoise, DepthSensor
from simulation.cameras.raycast import RaycastRenderer
from simulation.world.scene import Body
from simulation.world.world import World

FACING_DOWN = np.diag((1.0, -1.0, -1.0))

HALF_WIDTH_M = 4.0
"""Half the width of the table. It fills the image of a D435i up to 3 m above it."""

CELL_HALF_M = 1.0
"""Half the width of the cell. Things stand within this of the optical axis; a small cell is quick to make."""

SLAB_THICK_M = 0.02

BLUR_M = 0.05
"""Two standard deviations of depth at 2 m."""


class Stage:
    """A D435i in a cell that contains all static bodies. Things are added for one frame."""

    def __init__(self, T_world_camera: Transform, cell: Cell, noise: DepthNoise, seed: int) -> None:
        self.intrinsics = d435i_intrinsics()
        self.T_world_camera = T_world_camera
        self.cell = cell
        self._empty = World(cell).scene(0.0)
        self._renderer = RaycastRenderer(self.intrinsics, T_world_camera)
        self._sensor = DepthSensor(self.intrinsics, noise, seed)
        self._moment = 0

    def frame(self, *things: Body) -> SimulatedFrame:
        """Return the next frame with `things` on the stage. Each frame has noise of its own."""
        self._moment += 1
        view = self._renderer.render(replace(self._empty, moving=things))
        return SimulatedFrame(self._sensor.measure(view.z_m, self._moment), view, None)

    def pipeline(self, settings: FilterSettings, cell: Cell | None = None) -> DepthPipeline:
        """Return a filter for this camera in `cell`, by default in the stage's own cell."""
        return DepthPipeline(self.intrinsics, self.T_world_camera, cell or self.cell, settings)


def above_table(height_m: float, noise: DepthNoise, seed: int) -> Stage:
    """Return a stage with a camera `height_m` above the middle of a table."""
    table = slab("table", 2.0 * HALF_WIDTH_M, from_rotation_translation(np.eye(3), (0.0, 0.0, -0.5 * SLAB_THICK_M)))
    low, high = (-CELL_HALF_M, -CELL_HALF_M, -0.5), (CELL_HALF_M, CELL_HALF_M, 3.0)
    cell = Cell("stage", np.array(low), np.array(high), (table,))
    return Stage(from_rotation_translation(FACING_DOWN, (0.0, 0.0, height_m)), cell, noise, seed)


def slab(name: str, side_m: float, T_world_middle: Transform) -> PlacedMesh:
    """Return a square slab, `SLAB_THICK_M` along its z."""
    return PlacedMesh(name, box_mesh(name, (side_m, side_m, SLAB_THICK_M)), T_world_middle)


def lying(heading_rad: float, tilt_rad: float) -> NDArray[np.float64]:
    """Return a rotation (3, 3) that turns z, a cylinder's axis, to `heading_rad` in the xy plane and `tilt_rad` out of
    it.
    """
    x, y = math.cos(heading_rad), math.sin(heading_rad)
    axis = np.array((math.cos(tilt_rad) * x, math.cos(tilt_rad) * y, math.sin(tilt_rad)))
    side = np.array((-y, x, 0.0))
    return np.stack((np.cross(side, axis), side, axis), axis=1)


def reported_at(voxels: Voxels, body: Body) -> bool:
    """Return True if a voxel is reported within one voxel and `BLUR_M` of the bounding box of `body`."""
    if not len(voxels):
        return False
    points = apply(body.T_world_mesh, body.mesh.vertices)
    reach_m = voxels.lattice.voxel_size_m + BLUR_M
    centres = voxels.lattice.centres(voxels.indices)
    return bool(
        ((centres >= points.min(axis=0) - reach_m) & (centres <= points.max(axis=0) + reach_m)).all(axis=1).any()
    )
