# SPDX-License-Identifier: Apache-2.0
"""Voxels with too few points are noise (the paper's Algorithms 6 and 7, and our departure).

The paper deletes each voxel that holds less than a share of the points that a full one would show at its
distance; a flat hand on a border is thus split into two halves and disappears. Here the points of the 27 voxels
around decide, and a voxel by itself only needs a small share.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edge_unit.kernels.jit import kernel

FLOOR_VOXELS = 3.0
"""The floor of points never asks for more than this many full voxels: small voxels far away hold few points, and a
surface that crosses the neighbourhood fills about nine."""


@kernel
def expected_pinhole(size_m: float, z_m: float, fx: float, fy: float) -> float:
    """Points that a square of `size_m` facing the camera at depth `z_m` shows."""
    side = size_m / max(z_m, 1e-3)
    return fx * fy * side * side


@kernel
def expected_angular(size_m: float, distance_m: float, degrees_per_column: float, degrees_per_row: float) -> float:
    """The paper's Algorithm 6: the same from degrees per pixel, averaged over the whole view."""
    angle_deg = math.degrees(math.atan(size_m / max(distance_m, 1e-3)))
    return (angle_deg / degrees_per_column) * (angle_deg / degrees_per_row)


@kernel
def neighbourhood_count(counts: NDArray[np.uint32], ix: int, iy: int, iz: int, nx: int, ny: int, nz: int) -> int:
    """Points in the 27 voxels around (ix, iy, iz), those outside the lattice being empty."""
    total = 0
    for jx in range(max(ix - 1, 0), min(ix + 1, nx - 1) + 1):
        for jy in range(max(iy - 1, 0), min(iy + 1, ny - 1) + 1):
            row = (jx * ny + jy) * nz
            for jz in range(max(iz - 1, 0), min(iz + 1, nz - 1) + 1):
                total += counts[row + jz]
    return total


@kernel
def keep_dense(
    counts: NDArray[np.uint32],
    touched: NDArray[np.uint32],
    found: int,
    shape: NDArray[np.int32],
    voxel_size_m: float,
    first_centre_camera_m: NDArray[np.float64],
    axes_camera: NDArray[np.float64],
    fx: float,
    fy: float,
    degrees_per_column: float,
    degrees_per_row: float,
    angular: bool,
    single: bool,
    threshold: float,
    own_share_min: float,
    support_area_max_m2: float,
    support_points_min: float,
    kept: NDArray[np.uint32],
) -> int:
    """List the touched voxels that are dense enough in `kept`; returns how many.

    `first_centre_camera_m` (3,) is the middle of voxel (0, 0, 0) in the camera frame and `axes_camera` (3, 3) has as
    columns the steps to the next voxel along each lattice axis. `single` is the paper's Algorithm 7: a voxel's own
    count against `threshold` of the full count. Else the 27-neighbourhood is held against `threshold` of the full count
    of at most `support_area_max_m2`, but no less than `support_points_min` or `FLOOR_VOXELS` full voxels, and the
    voxel's own against `own_share_min`.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    area_m2 = voxel_size_m * voxel_size_m
    cap = 1.0 if single else min(support_area_max_m2 / area_m2, 1.0)
    number = 0
    for i in range(found):
        key = np.int64(touched[i])
        iz = key % nz
        iy = key // nz % ny
        ix = key // (nz * ny)
        x = first_centre_camera_m[0] + axes_camera[0, 0] * ix + axes_camera[0, 1] * iy + axes_camera[0, 2] * iz
        y = first_centre_camera_m[1] + axes_camera[1, 0] * ix + axes_camera[1, 1] * iy + axes_camera[1, 2] * iz
        z = first_centre_camera_m[2] + axes_camera[2, 0] * ix + axes_camera[2, 1] * iy + axes_camera[2, 2] * iz
        if angular:
            full = expected_angular(voxel_size_m, math.sqrt(x * x + y * y + z * z), degrees_per_column, degrees_per_row)
        else:
            full = expected_pinhole(voxel_size_m, z, fx, fy)
        own = counts[key]
        if single:
            dense = own >= threshold * full
        else:
            needed = max(threshold * cap * full, min(support_points_min, FLOOR_VOXELS * full))
            dense = own >= own_share_min * full and (
                own >= needed or neighbourhood_count(counts, ix, iy, iz, nx, ny, nz) >= needed
            )
        if dense:
            kept[number] = touched[i]
            number += 1
    return number
