# SPDX-License-Identifier: Apache-2.0
"""The pixels that nothing known explains: one pass at memory speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_unit.kernels.jit import kernel


@kernel
def foreground_mask(
    depth_raw: NDArray[np.uint16],
    static_limit_raw: NDArray[np.uint16],
    robot_near_raw: NDArray[np.uint16],
    robot_span_raw: NDArray[np.uint16],
    robot_rows: NDArray[np.int32],
    minimum_raw: int,
    mask: NDArray[np.uint8],
) -> None:
    """Mark pixels that are nearer than the static limit and not robot.

    All images (H, W); `mask` (H, at least W) gets 1 or 0. `robot_rows` (4,): first and last row, first and
    last column outside of which no robot was drawn. Depth 0 is no measurement and never foreground;
    neither is what lies below `minimum_raw` (at least 1).

    Both bounds are one unsigned compare, for `low <= d < high` is `d - low < high - low` modulo 2**16.
    """
    height, width = depth_raw.shape
    low = np.uint16(minimum_raw)
    first_row, last_row, first_column, last_column = robot_rows[0], robot_rows[1], robot_rows[2], robot_rows[3]
    for y in range(height):
        depth = depth_raw[y]
        limit = static_limit_raw[y]
        out = mask[y]
        for x in range(width):
            room = max(limit[x], low) - low
            out[x] = np.uint16(depth[x] - low) < np.uint16(room)
        if first_row <= y <= last_row:
            near = robot_near_raw[y]
            span = robot_span_raw[y]
            for x in range(first_column, last_column + 1):
                out[x] &= np.uint16(depth[x] - near[x]) > span[x]
