# SPDX-License-Identifier: Apache-2.0
"""Mask of the pixels that no known surface explains: one pass at memory speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.limits import Band


@kernel
def foreground_mask(
    depth_raw: NDArray[np.uint16],
    room_raw: NDArray[np.uint16],
    minimum_raw: int,
    robot: Band,
    mask: NDArray[np.uint8],
) -> None:
    """Mark pixels that are nearer than the static limit and not robot.

    All images are (H, W); `mask` (H, at least W) gets 1 or 0. `room_raw` is the static limit less `minimum_raw`, at
    least 0. Depths below `minimum_raw` (at least 1, since 0 is no measurement) are never foreground.

    Both bounds are one unsigned comparison: `low <= d < high` is `d - low < high - low` modulo 2**16.
    """
    robot = Band(*robot)
    low = np.uint16(minimum_raw)
    for y in range(len(depth_raw)):
        depth = depth_raw[y]
        room = room_raw[y]
        out = mask[y]
        for i in range(len(depth)):
            out[i] = np.uint16(depth[i] - low) < room[i]
        first, end = robot.columns[y, 0], robot.columns[y, 1]
        if first < end:
            depth = depth_raw[y, first:end]
            near = robot.near_raw[y, first:end]
            span = robot.span_raw[y, first:end]
            out = mask[y, first:end]
            for i in range(len(depth)):
                out[i] &= np.uint16(depth[i] - near[i]) > span[i]
