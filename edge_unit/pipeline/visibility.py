# SPDX-License-Identifier: Apache-2.0
"""Blocks of the cell that the camera looks through now; all else is unseen."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline.voxelizer import Voxels
from geometry.kernels import seen as kernels
from geometry.kernels.bundles import plain
from geometry.rendering.kernel_camera import camera_of
from geometry.rendering.mesh_renderer import NEAR_PLANE_M
from shared.camera import Intrinsics
from shared.lattice import Lattice, block_lattice
from shared.transforms import Transform, inverse

ROWS_LOOKED_AT = 360
"""Of a larger image only every second row is used, or every third: a block of 100 mm is 16 rows at 4 m."""

EDGE_SHARE = 1e-3
"""Part of a voxel: the inset of the probed points from its faces, so that rounding counts no neighbour."""

SIGMAS = 2.0
"""Standard deviations of depth by which a ray must end behind a block; an obstacle in the block then shows."""


@dataclass(frozen=True, eq=False)
class SeenBlocks:
    """Blocks of `lattice` that a frame looks through: `seen` (cell_count,) uint8, 0 or 1, in the order of the keys."""

    seen: NDArray[np.uint8]
    lattice: Lattice

    def coarser(self) -> SeenBlocks:
        """Return blocks of twice the edge, seen only if all of their parts are; parts beyond the box do not count."""
        nx, ny, nz = self.lattice.shape
        shape = ((nx + 1) // 2, (ny + 1) // 2, (nz + 1) // 2)
        padded = np.ones((2 * shape[0], 2 * shape[1], 2 * shape[2]), np.uint8)
        padded[:nx, :ny, :nz] = self.seen.reshape(nx, ny, nz)
        parts = padded.reshape(shape[0], 2, shape[1], 2, shape[2], 2)
        larger = Lattice(self.lattice.origin_m, 2.0 * self.lattice.voxel_size_m, shape)
        return SeenBlocks(parts.min(axis=(1, 3, 5)).reshape(-1), larger)

    def without(self, voxels: Voxels) -> SeenBlocks:
        """Return the same without the blocks that any of the `voxels` overlaps."""
        size_m, block_m = voxels.lattice.voxel_size_m, self.lattice.voxel_size_m
        low_m = voxels.lattice.centres(voxels.indices) - 0.5 * size_m
        seen = self.seen.copy()
        grid = seen.reshape(self.lattice.shape)
        # Along each axis no block between the first and the last is left out.
        inward = EDGE_SHARE * size_m
        steps_m = np.linspace(inward, size_m - inward, int(np.ceil(size_m / block_m)) + 1)
        for step_m in itertools.product(steps_m, repeat=3):
            at = np.floor((low_m + step_m - self.lattice.origin_m) / block_m).astype(np.intp)
            x, y, z = np.clip(at, 0, np.array(self.lattice.shape) - 1).T
            grid[x, y, z] = 0
        return SeenBlocks(seen, self.lattice)

    def packed(self) -> bytes:
        """Return one bit for each block, the first block in the lowest bit."""
        return np.packbits(self.seen, bitorder="little").tobytes()


class Visibility:
    """Probes the blocks of a cell from one camera's pose."""

    def __init__(
        self,
        intrinsics: Intrinsics,
        T_world_camera: Transform,
        box_min_m: NDArray[np.float64],
        box_max_m: NDArray[np.float64],
        block_size_m: float,
        share_min: float,
        noise_per_m: float,
    ) -> None:
        """A block is seen if at least `share_min` of its rays pass through it.

        `noise_per_m` is `c` of the camera's `sigma(z) = c * z**2`.
        """
        self.lattice = block_lattice(box_min_m, box_max_m, block_size_m)
        self._intrinsics = intrinsics
        self._share_min = share_min
        self._noise_per_m = SIGMAS * noise_per_m
        count = self.lattice.cell_count
        self._views = plain(kernels.Views(np.empty(count, np.int32), np.empty((count, 5), np.int32)))
        self._seen = np.zeros(self.lattice.cell_count, np.uint8)
        rows_apart = max(intrinsics.height // ROWS_LOOKED_AT, 1)
        reach_raw = np.empty((-(-intrinsics.height // rows_apart), intrinsics.width), np.uint16)
        self._looking = plain(kernels.Looking(rows_apart, reach_raw))
        self.place(T_world_camera)

    def place(self, T_world_camera: Transform) -> None:
        """Use another pose of the camera from now on."""
        camera, lattice = self._intrinsics, self.lattice
        blocks = kernels.Blocks(np.array(lattice.shape, np.int32), lattice.voxel_size_m, np.array(lattice.origin_m))
        measuring = kernels.Measuring(NEAR_PLANE_M, self._noise_per_m, camera.depth_scale_m)
        self._number = kernels.block_views(
            plain(blocks), inverse(T_world_camera), camera_of(camera), plain(measuring), self._views
        )

    def find_seen(
        self,
        depth_raw: NDArray[np.uint16],
        static_limit_raw: NDArray[np.uint16],
        robot_near_raw: NDArray[np.uint16],
    ) -> SeenBlocks:
        """Return the blocks that a frame looks through; images (H, W)."""
        kernels.seen_blocks(
            depth_raw,
            static_limit_raw,
            robot_near_raw,
            self._views,
            self._number,
            self._share_min,
            self._looking,
            self._seen,
        )
        return SeenBlocks(self._seen.copy(), self.lattice)
