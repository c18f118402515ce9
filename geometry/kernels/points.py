# SPDX-License-Identifier: Apache-2.0
"""From the image to the counter in one sweep: what follows on a row is done while the row is in the cache.

Thirty times a second each frame comes to a cold cache. Stage by stage, the mask would be written to memory and read
back, and the image read twice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.foreground import foreground_mask
from geometry.kernels.halo import drop_halo
from geometry.kernels.jit import kernel
from geometry.kernels.voxelize import count_points

ROWS_AT_ONCE = 16
"""Of all images together 150 kB at 1280 pixels: they fit the second cache of any board."""


@kernel
def count_foreground(
    depth_raw: NDArray[np.uint16],
    room_raw: NDArray[np.uint16],
    robot_near_raw: NDArray[np.uint16],
    robot_span_raw: NDArray[np.uint16],
    robot_columns: NDArray[np.int32],
    minimum_raw: int,
    halo_runs: NDArray[np.int32],
    halo_near_raw: NDArray[np.uint16],
    halo_span_raw: NDArray[np.uint16],
    column_rays: NDArray[np.float32],
    row_rays: NDArray[np.float32],
    origin: NDArray[np.float32],
    shape: NDArray[np.int32],
    mask_words: NDArray[np.uint64],
    mask: NDArray[np.uint8],
    slots: NDArray[np.int32],
    counts: NDArray[np.uint32],
    touched: NDArray[np.uint32],
) -> int:
    """`foreground_mask`, `drop_halo` and `count_points` on a few rows at a time; returns how many voxels were touched.

    Arguments as theirs; `mask` (ROWS_AT_ONCE, stride) and the same memory as `mask_words` are scratch.
    """
    height = len(depth_raw)
    run, found = 0, 0
    for top in range(0, height, ROWS_AT_ONCE):
        end = min(top + ROWS_AT_ONCE, height)
        depth = depth_raw[top:end]
        foreground_mask(
            depth,
            room_raw[top:end],
            robot_near_raw[top:end],
            robot_span_raw[top:end],
            robot_columns[top:end],
            minimum_raw,
            mask,
        )
        first_run = run
        while run < len(halo_runs) and halo_runs[run, 0] < end:
            run += 1
        drop_halo(depth, top, halo_runs[first_run:run], halo_near_raw, halo_span_raw, mask)
        found = count_points(
            depth, mask_words, mask, column_rays, row_rays[top:end], origin, shape, slots, counts, touched, found
        )
    return found
