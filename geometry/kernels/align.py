# SPDX-License-Identifier: Apache-2.0
"""How far measured points lie from the planes that they should lie on, as seen from a pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import deproject, moved, nearest_pixel, project, rows_of, rows_of_32

UNKNOWN_COST = 0.5
"""Of a point that falls where nothing is known: neither does it fit, nor does it not."""


@kernel
def plane_cost(
    points_m: NDArray[np.float32],
    expected_m: NDArray[np.float32],
    obliqueness: NDArray[np.float32],
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
    T_expected_there: NDArray[np.float64],
    scale_m: NDArray[np.float32],
    distances_m: NDArray[np.float32],
) -> float:
    """Robust sum of the points' distances from the expected planes, if the camera stood elsewhere.

    `points_m` (3, N) in the frame of a camera that stands there, which `T_expected_there` (4, 4) maps into the frame
    that `expected_m` (H, W) was drawn in (inf: nothing known). A depth's difference times `obliqueness` (H, W) is the
    distance from the plane there. A distance `d` counts `d**2 / (scale**2 + d**2)`, so that what is unknown and near
    counts 1 wherever the camera stands. Out: `distances_m` (N,), NaN where nothing is known.
    """
    rows = rows_of_32(T_expected_there)
    fx, fy, cx, cy = (
        np.float32(focal_px[0]),
        np.float32(focal_px[1]),
        np.float32(centre_px[0]),
        np.float32(centre_px[1]),
    )
    one = np.float32(1.0)
    height, width = expected_m.shape
    total = np.float64(0.0)
    for i in range(points_m.shape[1]):
        there_x, there_y, there_z = moved(rows, points_m[0, i], points_m[1, i], points_m[2, i])
        cost = np.float64(UNKNOWN_COST)
        distances_m[i] = np.nan
        if there_z > 0.0:
            u_px, v_px = project(there_x, there_y, one / there_z, fx, fy, cx, cy)
            u, v = nearest_pixel(u_px), nearest_pixel(v_px)
            if 0 <= u < width and 0 <= v < height:
                expected = expected_m[np.uint64(v), np.uint64(u)]
                if np.isfinite(expected):
                    distance = (there_z - expected) * obliqueness[np.uint64(v), np.uint64(u)]
                    distances_m[i] = distance
                    r = np.float64(distance / scale_m[i])
                    cost = r * r / (1.0 + r * r)
        total += cost
    return total


@kernel
def normal_equations(
    points_m: NDArray[np.float32],
    expected_m: NDArray[np.float32],
    normals: NDArray[np.float32],
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
    T_expected_there: NDArray[np.float64],
    scale_m: NDArray[np.float32],
    information: NDArray[np.float64],
    gradient: NDArray[np.float64],
) -> None:
    """Gauss and Newton's equations of `plane_cost` for a small motion of the camera in the expected frame.

    `normals` (H, W, 3) of the planes in that frame, NaN at edges. Out: `information` (6, 6) and `gradient` (6,) of the
    turn and then the shift, both weighted by the robust cost.
    """
    information[:] = 0.0
    gradient[:] = 0.0
    rows = rows_of(T_expected_there)
    fx, fy = focal_px
    cx, cy = centre_px
    height, width = expected_m.shape
    jacobian = np.empty(6)
    for i in range(points_m.shape[1]):
        x, y, z = np.float64(points_m[0, i]), np.float64(points_m[1, i]), np.float64(points_m[2, i])
        px, py, pz = moved(rows, x, y, z)
        if pz <= 0.0:
            continue
        u_px, v_px = project(px, py, 1.0 / pz, fx, fy, cx, cy)
        u, v = nearest_pixel(u_px), nearest_pixel(v_px)
        if not (0 <= u < width and 0 <= v < height):
            continue
        nx, ny, nz = np.float64(normals[v, u, 0]), np.float64(normals[v, u, 1]), np.float64(normals[v, u, 2])
        if not np.isfinite(nx):
            continue
        # The plane goes through the expected point of that pixel.
        qx, qy, qz = deproject(u, v, np.float64(expected_m[v, u]), fx, fy, cx, cy)
        distance = nx * (px - qx) + ny * (py - qy) + nz * (pz - qz)
        r = distance / scale_m[i]
        weight = 1.0 / (1.0 + r * r) ** 2 / scale_m[i] ** 2
        jacobian[0] = py * nz - pz * ny
        jacobian[1] = pz * nx - px * nz
        jacobian[2] = px * ny - py * nx
        jacobian[3], jacobian[4], jacobian[5] = nx, ny, nz
        for a in range(6):
            gradient[a] += weight * distance * jacobian[a]
            for b in range(6):
                information[a, b] += weight * jacobian[a] * jacobian[b]
