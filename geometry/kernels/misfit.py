# SPDX-License-Identifier: Apache-2.0
"""How badly a frame fits what is known, from where the camera should be and from places close by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.agreement import Tolerance
from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import Camera, deproject, in_32, moved, nearest_pixel, project, rows_of_32

UNKNOWN_MISFIT = 0.5
"""Of a pixel that falls where nothing is known: neither does it fit, nor does it not."""


@kernel
def compared_points(
    depth_raw: NDArray[np.uint16],
    static_raw: NDArray[np.uint16],
    robot_near_raw: NDArray[np.uint16],
    camera: Camera,
    tolerance: Tolerance,
    stride_px: int,
    points_raw: NDArray[np.float32],
    tallies: NDArray[np.int64],
) -> int:
    """Every `stride_px`-th measured pixel that the robot may not cover, as a point in the camera frame.

    `static_raw` (H, W) is the expected raw depth, 0 where nothing is known. Out: `points_raw` (3, N), of which as many
    columns as are returned; `tallies` (4,) = pixels looked at, of these before a known surface, measured, and farther
    away than the surface there by more than the tolerance, which a correct picture cannot show.
    """
    camera, tolerance = Camera(*camera), Tolerance(*tolerance)
    tallies[:] = 0
    height, width = depth_raw.shape
    points = 0
    for y in range(stride_px // 2, height, stride_px):
        for x in range(stride_px // 2, width, stride_px):
            tallies[0] += 1
            expected = np.float64(static_raw[y, x])
            tallies[1] += expected > 0.0
            raw = depth_raw[y, x]
            if raw == 0:
                continue
            tallies[2] += 1
            if robot_near_raw[y, x] < 65535:
                continue
            z = np.float64(raw)
            if expected > 0.0 and z - expected > tolerance.base_raw + tolerance.per_raw2 * expected * expected:
                tallies[3] += 1
            points_raw[0, points], points_raw[1, points], points_raw[2, points] = deproject(x, y, z, camera)
            points += 1
    return points


@kernel
def misfit_there(
    points_raw: NDArray[np.float32],
    points: int,
    static_raw: NDArray[np.uint16],
    camera: Camera,
    T_expected_there: NDArray[np.float64],
    scale: Tolerance,
) -> float:
    """How badly points fit the static surfaces if the camera stood elsewhere, summed.

    `T_expected_there` (4, 4), its translation in raw units, maps points of a camera that stands there into the frame
    from which `static_raw` (H, W) was drawn. A residual `r` in scales counts `r**2 / (1 + r**2)`, so that what is
    unknown and near counts 1 wherever the camera stands.
    """
    rows = rows_of_32(T_expected_there)
    lens = in_32(Camera(*camera))
    scale = Tolerance(*scale)
    base, per = np.float32(scale.base_raw), np.float32(scale.per_raw2)
    one = np.float32(1.0)
    height, width = static_raw.shape
    total = np.float64(0.0)
    for i in range(points):
        z = points_raw[2, i]
        there_x, there_y, there_z = moved(rows, points_raw[0, i], points_raw[1, i], z)
        misfit = np.float32(UNKNOWN_MISFIT)
        if there_z > 0.0:
            u_px, v_px = project(there_x, there_y, one / there_z, lens)
            u, v = nearest_pixel(u_px), nearest_pixel(v_px)
            if 0 <= u < width and 0 <= v < height:
                expected = static_raw[np.uint64(v), np.uint64(u)]
                if expected > 0:
                    r = (there_z - np.float32(expected)) / (base + per * z * z)
                    misfit = r * r / (one + r * r)
        total += np.float64(misfit)
    return total
