# SPDX-License-Identifier: Apache-2.0
"""From the image to the counter in one sweep: all steps of a row run while the row is in the cache.

Each frame arrives in a cold cache, thirty times a second. Stage by stage, the mask would be written to memory and read
back, and the image read twice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.foreground import foreground_mask
from geometry.kernels.halo import Halo, drop_halo
from geometry.kernels.jit import kernel
from geometry.kernels.limits import Band
from geometry.kernels.voxelize import Counter, Grid, Mask, count_points

ROWS_AT_ONCE = 16
"""Rows processed at once: 150 kB of all images at a width of 1280 pixels fit the second-level cache of any board."""


@kernel
def count_foreground(
    depth_raw: NDArray[np.uint16],
    room_raw: NDArray[np.uint16],
    minimum_raw: int,
    robot: Band,
    halo: Halo,
    grid: Grid,
    mask: Mask,
    counter: Counter,
) -> int:
    """Run `foreground_mask`, `drop_halo` and `count_points` on a few rows at a time; return the voxels touched.

    The arguments are theirs; `mask`, of ROWS_AT_ONCE rows, is scratch.
    """
    robot, halo, grid, mask, counter = Band(*robot), Halo(*halo), Grid(*grid), Mask(*mask), Counter(*counter)
    height = len(depth_raw)
    run, found = 0, 0
    for top in range(0, height, ROWS_AT_ONCE):
        end = min(top + ROWS_AT_ONCE, height)
        depth = depth_raw[top:end]
        here = Band(robot.near_raw[top:end], robot.span_raw[top:end], robot.columns[top:end])
        foreground_mask(depth, room_raw[top:end], minimum_raw, here, mask.pixels)
        first_run = run
        while run < len(halo.runs) and halo.runs[run, 0] < end:
            run += 1
        drop_halo(depth, top, Halo(halo.runs[first_run:run], halo.near_raw, halo.span_raw), mask.pixels)
        rows = Grid(grid.column_rays, grid.row_rays[top:end], grid.origin, grid.shape)
        found = count_points(depth, mask, rows, counter, found)
    return found
