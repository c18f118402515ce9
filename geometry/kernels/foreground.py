# SPDX-License-Identifier: Apache-2.0
"""The pixels that nothing known explains: one pass at memory speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel


@kernel
def foreground_mask(
    depth_raw: NDArray[np.uint16],
    room_raw: NDArray[np.uint16],
    robot_near_raw: NDArray[np.uint16],
    robot_span_raw: NDArray[np.uint16],
    robot_columns: NDArray[np.int32],
    minimum_raw: int,
    mask: NDArray[np.uint8],
) -> None:
    """Mark pixels that are nearer than the static limit and not robot.

    All images (H, W); `mask` (H, at least W) gets 1 or 0. `room_raw` is the static limit less `minimum_raw`, or 0;
    depths below `minimum_raw` (at least 1, for 0 is no measurement) are never foreground. `robot_columns` (H, 2): of
    each row the first column and the one after the last that the robot may reach.

    Both bounds are one unsigned compare, for `low <= d < high` is `d - low < high - low` modulo 2**16.
    """
    low = np.uint16(minimum_raw)
    for y in range(len(depth_raw)):
        depth = depth_raw[y]
        room = room_raw[y]
        out = mask[y]
        for i in range(len(depth)):
            out[i] = np.uint16(depth[i] - low) < room[i]
        first, end = robot_columns[y, 0], robot_columns[y, 1]
        if first < end:
            depth = depth_raw[y, first:end]
            near = robot_near_raw[y, first:end]
            span = robot_span_raw[y, first:end]
            out = mask[y, first:end]
            for i in range(len(depth)):
                out[i] &= np.uint16(depth[i] - near[i]) > span[i]
