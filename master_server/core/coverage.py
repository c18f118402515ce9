# SPDX-License-Identifier: Apache-2.0
"""The union of the blocks that the units see; a block that no live unit reports as seen is unseen."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from shared.errors import WireError
from shared.lattice import Lattice
from shared.messages import Matrix, SeenReport
from shared.wire import unpack_seen

FACTOR_TOLERANCE = 1e-6
"""Tolerance: block sizes are multiples of one another up to rounding."""


class Coverage:
    """One seen grid for each unit, on the blocks of the cell."""

    def __init__(self, blocks: Lattice) -> None:
        """`blocks` is the cell's box in the smallest blocks that a unit may report."""
        self.blocks = blocks
        self._seen: dict[int, NDArray[np.bool_]] = {}

    def report(self, unit_id: int, report: SeenReport) -> None:
        """Store the unit's seen blocks; a larger block covers all blocks inside it.

        Raises:
            WireError: the report is damaged, or its block size is not a multiple of the cell's.
        """
        ratio = report.block_size_m / self.blocks.voxel_size_m
        factor = round(ratio)
        if factor < 1 or abs(ratio - factor) > FACTOR_TOLERANCE * ratio:
            raise WireError(
                f"seen.block_size_m: expected a multiple of {self.blocks.voxel_size_m}, got {report.block_size_m}"
            )
        grid = unpack_seen(report)
        if grid.shape == self.blocks.shape and factor == 1:
            self._seen[unit_id] = grid
            return
        # Crop before the blocks are refined, so that the memory is bounded by the cell, not by the report.
        grid = grid[tuple(slice(-(-count // factor)) for count in self.blocks.shape)]
        for axis, count in enumerate(self.blocks.shape):
            grid = grid.repeat(min(factor, count), axis=axis)
        seen = np.zeros(self.blocks.shape, dtype=np.bool_)
        nx, ny, nz = (min(have, want) for have, want in zip(grid.shape, seen.shape, strict=True))
        seen[:nx, :ny, :nz] = grid[:nx, :ny, :nz]
        self._seen[unit_id] = seen

    def withdraw(self, unit_id: int) -> None:
        """Remove the unit's seen report, if there is one."""
        self._seen.pop(unit_id, None)

    def has(self, unit_id: int) -> bool:
        """Return True if the unit has reported."""
        return unit_id in self._seen

    def range_m(self, unit_id: int, T_world_camera: Matrix) -> float | None:
        """Return the depth of the unit's farthest seen block, in its camera's frame; None without a report."""
        seen = self._seen.get(unit_id)
        if seen is None:
            return None
        if not seen.any():
            return None
        # The depth of a block's centre is linear in its indices, so no points have to be computed. Blocks that are not
        # seen count as no deeper than the camera itself.
        forward, eye = np.array(T_world_camera)[:3, 2], np.array(T_world_camera)[:3, 3]
        edge_m = self.blocks.voxel_size_m
        first = float(forward @ (np.array(self.blocks.origin_m) + 0.5 * edge_m - eye))
        x, y, z = (
            np.arange(count, dtype=np.float32) * np.float32(edge_m * step)
            for count, step in zip(seen.shape, forward, strict=True)
        )
        depth_m = (np.float32(first) + x[:, None] + y)[..., None] + z
        depth_m *= seen
        return max(float(depth_m.max()), 0.0)

    def seen_by(self, unit_ids: Iterable[int]) -> NDArray[np.uint8]:
        """Return the number of these units that see each block, in the blocks' shape, uint8."""
        counts = np.zeros(self.blocks.shape, dtype=np.uint8)
        for unit_id in unit_ids:
            seen = self._seen.get(unit_id)
            if seen is not None:
                counts += seen
        return counts
