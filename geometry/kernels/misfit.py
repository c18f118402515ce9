# SPDX-License-Identifier: Apache-2.0
"""Misfit of a frame to the known surfaces, for a camera at its assumed pose and at poses close by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.agreement import Tolerance
from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import Camera, deproject, in_32, moved, nearest_pixel, project, rows_of_32

UNKNOWN_MISFIT = 0.5
"""Cost of a point without a known surface: it neither agrees nor disagrees."""


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
    """Collect every `stride_px`-th measured pixel that the robot cannot cover, as points in the camera frame.

    `static_raw` (H, W) is the expected raw depth, 0 if not known. Returns the number of points N; out: the first N
    columns of `points_raw` (3, .), in raw units; `tallies` (4,), the counts of sampled pixels, of those with a known
    surface, of measured ones, and of those farther than the surface by more than the tolerance, which is impossible for
    a camera at its assumed pose.
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
    """Return the sum of the robust costs of points against the static surfaces, for a camera at another pose.

    `T_expected_there` (4, 4), with its translation in raw units, maps points from the frame of the camera at that pose
    into the frame for which `static_raw` (H, W) was rendered. `points_raw` (3, .) has `points` valid columns.

    The residual of a point at depth `z` is `r = (z_there - expected) / s` with the scale
    `s = scale.base_raw + scale.per_raw2 * z**2`, the noise of a depth camera: `z_there` is the depth of the point in
    the expected frame, `expected` the surface at its pixel. Its cost is that of Geman and McClure,

        rho(r) = r**2 / (1 + r**2),

    which is quadratic for small residuals and bounded by 1. So points of an unknown obstacle, which fit at no pose,
    cost about 1 each at every pose: they shift the sum by a constant, and the points on known surfaces
    determine the minimum over poses. A point behind the camera, outside the image or without a known surface costs
    `UNKNOWN_MISFIT`, the cost of `r = 1`, so that a pose that moves points out of view gains little.
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
