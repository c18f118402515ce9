# SPDX-License-Identifier: Apache-2.0
"""Turns foreground pixels into voxels of the cell's lattice (Algorithms 1, 6 and 7)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline.edge_halo import EdgeHalo
from edge_unit.pipeline.expected_depth import RobotLayer
from edge_unit.pipeline.stage_times import StageRunner
from geometry.kernels import density, points, voxelize
from geometry.kernels.bundles import plain
from shared.camera import Intrinsics
from shared.lattice import Lattice
from shared.settings import FilterSettings
from shared.transforms import Transform, apply, inverse


@dataclass(frozen=True, eq=False)
class Voxels:
    """Obstacle voxels of one frame.

    Attributes:
        keys: (N,) uint32, ascending, in the order of `Lattice.keys`.
        counts: (N,) uint32, the number of foreground pixels in each.
        lattice: the lattice of the keys.
    """

    keys: NDArray[np.uint32]
    counts: NDArray[np.uint32]
    lattice: Lattice

    @property
    def indices(self) -> NDArray[np.int16]:
        """Lattice indices (N, 3) int16."""
        return self.lattice.indices(self.keys)

    def __len__(self) -> int:
        return len(self.keys)

    def nearest(self, position_m: NDArray[np.float64], most: int) -> tuple[Voxels, Voxels]:
        """Return at most so many of them, nearest to a point (3,) of the world, and the others."""
        distance_m = np.linalg.norm(self.lattice.centres(self.indices) - position_m, axis=1)
        chosen = np.zeros(len(self), np.bool_)
        chosen[np.argsort(distance_m, kind="stable")[:most]] = True
        return self._only(chosen), self._only(~chosen)

    def _only(self, chosen: NDArray[np.bool_]) -> Voxels:
        return Voxels(self.keys[chosen], self.counts[chosen], self.lattice)


class Voxelizer:
    """Counts points on the lattice for one camera; its memory is allocated once, for the worst frame."""

    def __init__(
        self, intrinsics: Intrinsics, T_world_camera: Transform, lattice: Lattice, settings: FilterSettings
    ) -> None:
        self.lattice = lattice
        self._intrinsics = intrinsics
        most = min(intrinsics.width * intrinsics.height, lattice.cell_count)
        self._shape = np.array(lattice.shape, np.int32)
        self._counts = np.zeros(int(np.prod(self._shape + 2, dtype=np.int64)) + 1, np.uint32)
        stride = -(-intrinsics.width // voxelize.PIXELS_PER_WORD) * voxelize.PIXELS_PER_WORD
        # The column behind the image's last one stays zero.
        mask = np.zeros((points.ROWS_AT_ONCE, stride), np.uint8)
        self._mask = plain(voxelize.Mask(mask.view(np.uint64), mask))
        self._touched = np.empty(most + 1, np.uint32)
        self._counter = plain(voxelize.Counter(self._counts, self._touched, np.empty(intrinsics.width, np.int32)))
        self._kept = np.empty(most + 1, np.uint32)
        self._kept_counts = np.empty(most + 1, np.uint32)
        scratch, keys = np.empty((6, density.AT_ONCE)), np.empty(density.AT_ONCE, np.uint32)
        self._judged = plain(density.Kept(self._kept, self._kept_counts, scratch, keys))
        self._rule = plain(
            density.Rule(
                settings.density_model == "angular",
                settings.density_rule == "single",
                settings.occupancy_threshold,
                settings.own_share_min,
                settings.support_area_max_m2,
                settings.support_points_min,
            )
        )
        self.place(T_world_camera)

    def place(self, T_world_camera: Transform) -> None:
        """Use another pose of the camera from now on."""
        camera, lattice = self._intrinsics, self.lattice
        voxels_per_m = T_world_camera[:3, :3] / lattice.voxel_size_m
        per_raw = voxels_per_m * camera.depth_scale_m
        u = (np.arange(camera.width) - camera.cx) / camera.fx
        v = (np.arange(camera.height) - camera.cy) / camera.fy
        self._grid = plain(
            voxelize.Grid(
                column_rays=(per_raw[:, :1] * u + per_raw[:, 2:]).astype(np.float32),
                row_rays=(v[:, None] * per_raw[:, 1]).astype(np.float32),
                origin=((T_world_camera[:3, 3] - lattice.origin_m) / lattice.voxel_size_m).astype(np.float32),
                shape=self._shape,
            )
        )
        T_camera_world = inverse(T_world_camera)
        self._view = plain(
            density.View(
                self._shape,
                lattice.voxel_size_m,
                first_centre_camera_m=apply(T_camera_world, lattice.centres(np.zeros(3))),
                axes_camera=np.ascontiguousarray(T_camera_world[:3, :3] * lattice.voxel_size_m),
                fx=camera.fx,
                fy=camera.fy,
                degrees_per_column=math.degrees(2.0 * math.atan(camera.width / (2.0 * camera.fx))) / camera.width,
                degrees_per_row=math.degrees(2.0 * math.atan(camera.height / (2.0 * camera.fy))) / camera.height,
            )
        )

    def voxels(
        self,
        depth_raw: NDArray[np.uint16],
        room_raw: NDArray[np.uint16],
        minimum_raw: int,
        robot: RobotLayer,
        halo: EdgeHalo,
        stages: StageRunner,
    ) -> Voxels:
        """Return the voxels that hold enough of the foreground of `depth_raw` (H, W).

        `room_raw` (H, W) and `minimum_raw` as in `foreground.foreground_mask`.
        """
        found = stages.run("foreground", self._count, depth_raw, room_raw, minimum_raw, robot, halo)
        return stages.run("density", self._keep_dense, found)

    def _count(
        self,
        depth_raw: NDArray[np.uint16],
        room_raw: NDArray[np.uint16],
        minimum_raw: int,
        robot: RobotLayer,
        halo: EdgeHalo,
    ) -> int:
        """Count the foreground on the lattice; returns the number of voxels that hold any."""
        return points.count_foreground(
            depth_raw,
            room_raw,
            minimum_raw,
            robot.bundle,
            halo.bundle,
            self._grid,
            self._mask,
            self._counter,
        )

    def _keep_dense(self, found: int) -> Voxels:
        """Return the voxels that hold enough points, and reset all `found` counts."""
        # In the order of memory: it is several times as fast, and the voxels come out sorted.
        self._touched[:found].sort()
        kept = density.keep_dense(self._counts, self._touched, found, self._view, self._rule, self._judged)
        voxelize.forget(self._counts, self._touched, found)
        return Voxels(self._kept[:kept].copy(), self._kept_counts[:kept].copy(), self.lattice)
