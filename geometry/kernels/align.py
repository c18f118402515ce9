# SPDX-License-Identifier: Apache-2.0
"""Distances of measured points from the expected planes, for a camera at a given pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import Camera, deproject, in_32, moved, nearest_pixel, project, rows_of, rows_of_32

UNKNOWN_COST = 0.5
"""Cost of a point without a known surface: it neither agrees nor disagrees."""


class Planes(NamedTuple):
    """Planes that `camera` is expected to see.

    `depth_m` (H, W), inf if not known. A difference of depths times `obliqueness` (H, W) is the distance from the plane
    at that pixel. `normals` (H, W, 3) of the planes in the camera frame, NaN at edges.
    """

    depth_m: NDArray[np.float32]
    obliqueness: NDArray[np.float32]
    normals: NDArray[np.float32]


class Measured(NamedTuple):
    """N points (3, N) in the frame of the measuring camera, with the scale `scale_m` (N,) of their distances."""

    points_m: NDArray[np.float32]
    scale_m: NDArray[np.float32]


@kernel
def plane_cost(
    measured: Measured,
    expected: Planes,
    camera: Camera,
    T_expected_there: NDArray[np.float64],
    distances_m: NDArray[np.float32],
) -> float:
    """Return the robust sum of the points' distances from the expected planes, for a camera at another pose.

    `T_expected_there` (4, 4) maps points from the frame of the camera at that pose into the frame of `expected`. A
    distance `d` costs `d**2 / (scale**2 + d**2)` (Geman and McClure), so an unknown obstacle nearby costs at most 1 at
    every pose. Out: `distances_m` (N,), NaN if not known.
    """
    measured, expected = Measured(*measured), Planes(*expected)
    points_m, scale_m, depth_m = measured.points_m, measured.scale_m, expected.depth_m
    lens = in_32(Camera(*camera))
    rows = rows_of_32(T_expected_there)
    one = np.float32(1.0)
    height, width = depth_m.shape
    total = np.float64(0.0)
    for i in range(points_m.shape[1]):
        there_x, there_y, there_z = moved(rows, points_m[0, i], points_m[1, i], points_m[2, i])
        cost = np.float64(UNKNOWN_COST)
        distances_m[i] = np.nan
        if there_z > 0.0:
            u_px, v_px = project(there_x, there_y, one / there_z, lens)
            u, v = nearest_pixel(u_px), nearest_pixel(v_px)
            if 0 <= u < width and 0 <= v < height:
                plane_z = depth_m[np.uint64(v), np.uint64(u)]
                if np.isfinite(plane_z):
                    distance = (there_z - plane_z) * expected.obliqueness[np.uint64(v), np.uint64(u)]
                    distances_m[i] = distance
                    r = np.float64(distance / scale_m[i])
                    cost = r * r / (1.0 + r * r)
        total += cost
    return total


@kernel
def normal_equations(
    measured: Measured,
    expected: Planes,
    camera: Camera,
    T_expected_there: NDArray[np.float64],
    information: NDArray[np.float64],
    gradient: NDArray[np.float64],
) -> None:
    """Compute the Gauss-Newton equations of `plane_cost` for a small motion of the camera in the expected frame.

    Out: `information` (6, 6) and `gradient` (6,) of the rotation, then the translation, weighted by the robust cost.
    """
    measured, expected, camera = Measured(*measured), Planes(*expected), Camera(*camera)
    points_m, scale_m, normals = measured.points_m, measured.scale_m, expected.normals
    information[:] = 0.0
    gradient[:] = 0.0
    rows = rows_of(T_expected_there)
    height, width = expected.depth_m.shape
    jacobian = np.empty(6)
    for i in range(points_m.shape[1]):
        x, y, z = np.float64(points_m[0, i]), np.float64(points_m[1, i]), np.float64(points_m[2, i])
        px, py, pz = moved(rows, x, y, z)
        if pz <= 0.0:
            continue
        u_px, v_px = project(px, py, 1.0 / pz, camera)
        u, v = nearest_pixel(u_px), nearest_pixel(v_px)
        if not (0 <= u < width and 0 <= v < height):
            continue
        nx, ny, nz = np.float64(normals[v, u, 0]), np.float64(normals[v, u, 1]), np.float64(normals[v, u, 2])
        if not np.isfinite(nx):
            continue
        # The plane goes through the expected point of that pixel.
        qx, qy, qz = deproject(u, v, np.float64(expected.depth_m[v, u]), camera)
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
