# SPDX-License-Identifier: Apache-2.0
"""One camera that looks straight down, and one thing below it: a bare scene whose every pixel is a ray cast by Embree.

The world's z axis points at the camera, which hangs `height_m` above the origin; a table, if there is one, has its
top at z = 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline import DepthPipeline, Voxels
from shared.camera import Intrinsics
from shared.cell import Cell, PlacedMesh
from shared.meshes import box_mesh
from shared.settings import FilterSettings
from shared.transforms import Transform, apply, from_rotation_translation
from simulation.cameras.camera import d435i_intrinsics
from simulation.cameras.depth_noise import DepthNoise, DepthSensor
from simulation.cameras.raycast import RaycastRenderer
from simulation.world.scene import Body, Capsules, Owner, Scene

FACING_DOWN = np.diag((1.0, -1.0, -1.0))

HALF_WIDTH_M = 4.0
"""The table fills the picture of a D435i up to 3 m above it."""

CELL_HALF_M = 1.0
"""Things stand within this of the optical axis; the cell is no larger, so that it is quick to make."""

BLUR_M = 0.05
"""Two standard deviations of depth at 2 m."""


class Stage:
    """A D435i above an empty table (or above nothing), to which one thing at a time is added."""

    def __init__(
        self, height_m: float, noise: DepthNoise, seed: int, table: bool = True, intrinsics: Intrinsics | None = None
    ) -> None:
        self.height_m = height_m
        self.intrinsics = intrinsics or d435i_intrinsics()
        self.T_world_camera: Transform = from_rotation_translation(FACING_DOWN, (0.0, 0.0, height_m))
        slab = box_mesh("table", (2.0 * HALF_WIDTH_M, 2.0 * HALF_WIDTH_M, 0.02))
        below = from_rotation_translation(np.eye(3), (0.0, 0.0, -0.01))
        self._fixed = (Body("table", slab, below, Owner.STATIC),) if table else ()
        self._known = (PlacedMesh("table", slab, below),) if table else ()
        self._renderer = RaycastRenderer(self.intrinsics, self.T_world_camera)
        self._sensor = DepthSensor(self.intrinsics, noise, seed)
        self._moment = 0

    def frame(self, *things: Body) -> NDArray[np.uint16]:
        """The next frame (H, W) with `things` on the stage; no two frames have the same noise."""
        self._moment += 1
        scene = Scene(self._fixed, things, Capsules.joined([]))
        return self._sensor.measure(self._renderer.render(scene).z_m, self._moment)

    def cell(self, shift_m: float, cad: bool) -> Cell:
        """The cell, its lattice's origin moved by `shift_m` along z; with `cad` the table is in it."""
        low = (-CELL_HALF_M, -CELL_HALF_M, -0.5 - shift_m)
        return Cell("stage", np.array(low), np.array((CELL_HALF_M, CELL_HALF_M, 3.0)), self._known if cad else ())

    def pipeline(self, settings: FilterSettings, shift_m: float = 0.0, cad: bool = True) -> DepthPipeline:
        """A filter for this camera in that cell."""
        return DepthPipeline(self.intrinsics, self.T_world_camera, self.cell(shift_m, cad), settings)


def reported_at(voxels: Voxels, body: Body) -> bool:
    """Whether a voxel is reported where `body` stands: within a voxel and `BLUR_M` of its bounding box."""
    if not len(voxels):
        return False
    points = apply(body.T_world_mesh, body.mesh.vertices)
    reach_m = voxels.lattice.voxel_size_m + BLUR_M
    centres = voxels.lattice.centres(voxels.indices)
    return bool(
        ((centres >= points.min(axis=0) - reach_m) & (centres <= points.max(axis=0) + reach_m)).all(axis=1).any()
    )
