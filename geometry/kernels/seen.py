# SPDX-License-Identifier: Apache-2.0
"""Blocks of the cell that a frame looks through.

A block is seen if enough of the rays through it are measured at or beyond its far side, and if its far side is nearer
than everything that could hide an obstacle: the static limit and the robot's band.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import Camera, moved, project, rows_of

RAYS_PER_SIDE = 6
"""Probes along each side of a block: about 6 x 6 of its pixels, so that 5 % of them decide nothing, at little cost."""


BLOCKED_MAX = 1
"""Limit of rays that may end before a block's far side: one is noise, more may be a finger too thin to be reported."""


class Blocks(NamedTuple):
    """Blocks of `size_m` that fill `shape` (3,) from `origin_m` (3,), numbered `(ix*ny + iy)*nz + iz`."""

    shape: NDArray[np.int32]
    size_m: float
    origin_m: NDArray[np.float64]


class Measuring(NamedTuple):
    """Properties of a depth camera: least range `near_m`, noise `noise_per_m * z**2`, and `depth_scale_m`."""

    near_m: float
    noise_per_m: float
    depth_scale_m: float


class Views(NamedTuple):
    """For each block entirely in the image, its number in `blocks`, and its extent in `views` (., 5).

    The extent is first and last row, first and last column, and the raw depth of the far corner plus the noise there:
    an object just inside may be measured that much farther.
    """

    blocks: NDArray[np.int32]
    views: NDArray[np.int32]


class Rectangle(NamedTuple):
    """Rows and columns of the probes."""

    first_row: int
    last_row: int
    first_column: int
    last_column: int


class Looking(NamedTuple):
    """Sampling: every `rows_apart`-th row is probed; `reach_raw` (H / rows_apart, rounded up, W) is scratch."""

    rows_apart: int
    reach_raw: NDArray[np.uint16]


@kernel
def block_views(
    grid: Blocks, T_camera_world: NDArray[np.float64], camera: Camera, measuring: Measuring, views: Views
) -> int:
    """List the blocks that are entirely in the image in `views`; return their number."""
    grid, camera, measuring, views = Blocks(*grid), Camera(*camera), Measuring(*measuring), Views(*views)
    shape, block_size_m, origin_m = grid
    near_m, noise_per_m, depth_scale_m = measuring
    blocks, rectangles = views
    rows = rows_of(T_camera_world)
    number = 0
    for ix in range(shape[0]):
        for iy in range(shape[1]):
            for iz in range(shape[2]):
                u_low, u_high, v_low, v_high = 1e9, -1e9, 1e9, -1e9
                z_low, z_high = 1e9, -1e9
                for corner in range(8):
                    wx = origin_m[0] + (ix + (corner & 1)) * block_size_m
                    wy = origin_m[1] + (iy + ((corner >> 1) & 1)) * block_size_m
                    wz = origin_m[2] + (iz + (corner >> 2)) * block_size_m
                    x, y, z = moved(rows, wx, wy, wz)
                    z_low = min(z_low, z)
                    z_high = max(z_high, z)
                    if z < near_m:
                        break
                    u, v = project(x, y, 1.0 / z, camera)
                    u_low, u_high = min(u_low, u), max(u_high, u)
                    v_low, v_high = min(v_low, v), max(v_high, v)
                far_raw = math.ceil((z_high + noise_per_m * z_high * z_high) / depth_scale_m)
                if z_low < near_m or far_raw > 65535 or u_low < 0.0 or v_low < 0.0:
                    continue
                if u_high > camera.width - 1 or v_high > camera.height - 1:
                    continue
                blocks[number] = (ix * shape[1] + iy) * shape[2] + iz
                rectangles[number, 0] = math.floor(v_low)
                rectangles[number, 1] = math.ceil(v_high)
                rectangles[number, 2] = math.floor(u_low)
                rectangles[number, 3] = math.ceil(u_high)
                rectangles[number, 4] = far_raw
                number += 1
    return number


@kernel
def reach_of_row(
    depth_raw: NDArray[np.uint16],
    static_limit_raw: NDArray[np.uint16],
    robot_near_raw: NDArray[np.uint16],
    reach_raw: NDArray[np.uint16],
) -> None:
    """Compute the depth up to which each ray of a row certainly passes; written for the vectoriser."""
    for x in range(len(reach_raw)):
        reach_raw[x] = min(depth_raw[x], min(static_limit_raw[x], robot_near_raw[x]))


@kernel
def passes(reach_raw: NDArray[np.uint16], rectangle: Rectangle, far_raw: int, share_min: float) -> bool:
    """Return True if at least `share_min` of the probed rays inside a rectangle reach `far_raw`.

    Any of the others may be unmeasured, but at most `BLOCKED_MAX` may end before it: a thin object blocks few rays.
    """
    first_row, last_row, first_column, last_column = rectangle
    row_step = max((last_row - first_row) // RAYS_PER_SIDE, 1)
    column_step = np.uint64(max((last_column - first_column) // RAYS_PER_SIDE, 1))
    rows = (last_row - first_row) // row_step + 1
    columns = (last_column - first_column) // np.int64(column_step) + 1
    probed = rows * columns
    needed = share_min * probed
    far = np.uint16(far_raw)
    possible = probed
    blocked = 0
    for y in range(first_row, last_row + 1, row_step):
        row = reach_raw[y]
        x = np.uint64(first_column)
        for _ in range(columns):
            possible -= int(row[x] < far)
            # Between 1 and far, by one unsigned comparison.
            blocked += int(np.uint16(row[x] - np.uint16(1)) < np.uint16(far - np.uint16(1)))
            x += column_step
        # Most blocks are seen entirely or not at all.
        if possible < needed or blocked > BLOCKED_MAX:
            return False
    return True


@kernel
def seen_blocks(
    depth_raw: NDArray[np.uint16],
    static_limit_raw: NDArray[np.uint16],
    robot_near_raw: NDArray[np.uint16],
    views: Views,
    number: int,
    share_min: float,
    looking: Looking,
    seen: NDArray[np.uint8],
) -> None:
    """Set `seen` (all blocks,) to 1 for blocks through which at least `share_min` of the probed rays pass, else to 0.

    Images are (H, W); the first `number` entries of `views`, from `block_views`, are valid.
    """
    rows_apart, reach_raw = Looking(*looking)
    blocks, rectangles = Views(*views)
    for y in range(len(reach_raw)):
        row = y * rows_apart
        # An unmeasured pixel has depth 0 and passes nothing.
        reach_of_row(depth_raw[row], static_limit_raw[row], robot_near_raw[row], reach_raw[y])
    seen[:] = 0
    for i in range(number):
        first_row, last_row = rectangles[i, 0] // rows_apart, rectangles[i, 1] // rows_apart
        rectangle = Rectangle(first_row, last_row, rectangles[i, 2], rectangles[i, 3])
        seen[blocks[i]] = passes(reach_raw, rectangle, rectangles[i, 4], share_min)
