# SPDX-License-Identifier: Apache-2.0
"""Removal of voxels with too few points as noise (the paper's Algorithms 6 and 7, and our departure).

The paper deletes each voxel with less than a share of the points of a full one at its distance. A flat hand on a border
between voxels is then split into two halves and disappears. Here the points of the 27 voxels around decide, and the
voxel itself needs only a small share.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel

FLOOR_VOXELS = 3.0
"""Limit of the least number of points, in full voxels: small voxels far away hold few points, and a surface that
crosses the neighbourhood fills about nine."""

AT_ONCE = 256
"""Voxels located at once before the decision: enough for the vectoriser, and they fit the first-level cache."""


class View(NamedTuple):
    """The voxels of a lattice of `shape` (3,) in the frame of one camera.

    `first_centre_camera_m` (3,) is the centre of voxel (0, 0, 0) in the camera frame. The columns of `axes_camera`
    (3, 3) are the steps to the next voxel along each lattice axis.
    """

    shape: NDArray[np.int32]
    voxel_size_m: float
    first_centre_camera_m: NDArray[np.float64]
    axes_camera: NDArray[np.float64]
    fx: float
    fy: float
    degrees_per_column: float
    degrees_per_row: float


class Rule(NamedTuple):
    """Points required in a voxel.

    `angular` selects the paper's Algorithm 6 for the full count. `single` selects Algorithm 7: a voxel's own count is
    compared with `threshold` of the full count. Otherwise the count of the 27-neighbourhood is compared with
    `threshold` of the full count of at most `support_area_max_m2`, but no less than `support_points_min` or
    `FLOOR_VOXELS` full voxels, and the voxel's own count with `own_share_min`.
    """

    angular: bool
    single: bool
    threshold: float
    own_share_min: float
    support_area_max_m2: float
    support_points_min: float


class Kept(NamedTuple):
    """`keys` and `counts` of the voxels kept; the arrays are at least one longer than the largest result.

    Scratch for the voxels under test: `judged` (6, AT_ONCE) and `judged_keys` (AT_ONCE,).
    """

    keys: NDArray[np.uint32]
    counts: NDArray[np.uint32]
    judged: NDArray[np.float64]
    judged_keys: NDArray[np.uint32]


class Asked(NamedTuple):
    """Points of a few voxels with their neighbours, and the required counts of the voxel alone and with neighbours."""

    around: NDArray[np.float64]
    own_needed: NDArray[np.float64]
    needed: NDArray[np.float64]


@kernel
def expected_pinhole(size_m: float, z_m: float, fx: float, fy: float) -> float:
    """Return the number of points of a square of `size_m` that faces the camera at depth `z_m`."""
    side = size_m / max(z_m, 1e-3)
    return fx * fy * side * side


@kernel
def expected_angular(size_m: float, distance_m: float, degrees_per_column: float, degrees_per_row: float) -> float:
    """Return the same by the paper's Algorithm 6: from degrees per pixel, averaged over the whole view."""
    angle_deg = math.degrees(math.atan(size_m / max(distance_m, 1e-3)))
    return (angle_deg / degrees_per_column) * (angle_deg / degrees_per_row)


@kernel
def neighbourhood_count(
    counts: NDArray[np.uint32], slot: np.uint64, slots_per_y: np.uint64, slots_per_x: np.uint64
) -> int:
    """Return the points in the 27 voxels around a slot of the counter with its rim (see `voxelize`)."""
    total = np.uint32(0)
    for jx in range(3):
        for jy in range(3):
            first = slot + np.uint64(jx) * slots_per_x + np.uint64(jy) * slots_per_y
            first -= slots_per_x + slots_per_y + np.uint64(1)
            total += counts[first] + counts[first + np.uint64(1)] + counts[first + np.uint64(2)]
    return total  # type: ignore[return-value]  # to numba it is a plain number


@kernel
def locate(
    slots: NDArray[np.uint32],
    view: View,
    keys: NDArray[np.uint32],
    z_m: NDArray[np.float64],
    distance_m: NDArray[np.float64],
) -> None:
    """Compute the key of the voxel of each slot, and the depth and distance of the voxel's centre from the camera.

    Written for the vectoriser, which cannot divide integers: it divides in floating point. A slot is below 2**28, and
    the added half outweighs the rounding of the inverse.
    """
    view = View(*view)
    shape, first_centre_camera_m, axes_camera = view.shape, view.first_centre_camera_m, view.axes_camera
    ny, nz = np.float64(shape[1]), np.float64(shape[2])
    per_z, per_y = 1.0 / (nz + 2.0), 1.0 / (ny + 2.0)
    x0, y0, z0 = first_centre_camera_m[0], first_centre_camera_m[1], first_centre_camera_m[2]
    xx, xy, xz = axes_camera[0, 0], axes_camera[0, 1], axes_camera[0, 2]
    yx, yy, yz = axes_camera[1, 0], axes_camera[1, 1], axes_camera[1, 2]
    zx, zy, zz = axes_camera[2, 0], axes_camera[2, 1], axes_camera[2, 2]
    for i in range(len(slots)):
        slot = np.float64(slots[i])
        row = np.floor((slot + 0.5) * per_z)
        plane = np.floor((row + 0.5) * per_y)
        iz = slot - row * (nz + 2.0) - 1.0
        iy = row - plane * (ny + 2.0) - 1.0
        ix = plane - 1.0
        keys[i] = np.uint32((ix * ny + iy) * nz + iz)
        x = x0 + xx * ix + xy * iy + xz * iz
        y = y0 + yx * ix + yy * iy + yz * iz
        z = z0 + zx * ix + zy * iy + zz * iz
        z_m[i] = z
        distance_m[i] = math.sqrt(x * x + y * y + z * z)


@kernel
def fill_pinhole(view: View, z_m: NDArray[np.float64], full: NDArray[np.float64]) -> None:
    """Fill `full` by `expected_pinhole`; a function of its own so that it is vectorised."""
    size_m, fx, fy = view.voxel_size_m, view.fx, view.fy
    for i in range(len(z_m)):
        full[i] = expected_pinhole(size_m, z_m[i], fx, fy)


@kernel
def fill_angular(view: View, distance_m: NDArray[np.float64], full: NDArray[np.float64]) -> None:
    """Fill `full` by `expected_angular`."""
    for i in range(len(distance_m)):
        full[i] = expected_angular(view.voxel_size_m, distance_m[i], view.degrees_per_column, view.degrees_per_row)


@kernel
def demand(full: NDArray[np.float64], rule: Rule, share: float, asked: Asked) -> None:
    """Compute the counts required of a voxel alone and with its 26 neighbours; `share` limits the area required."""
    own_needed, needed = asked.own_needed, asked.needed
    own_share = rule.threshold if rule.single else rule.own_share_min
    around_share = 0.0 if rule.single else rule.threshold * share
    floor_points, floor_voxels = (0.0, 0.0) if rule.single else (rule.support_points_min, FLOOR_VOXELS)
    for i in range(len(full)):
        own_needed[i] = own_share * full[i]
        needed[i] = max(around_share * full[i], min(floor_points, floor_voxels * full[i]))


@kernel
def sum_around(
    counts: NDArray[np.uint32],
    slots: NDArray[np.uint32],
    slots_per_y: np.uint64,
    slots_per_x: np.uint64,
    around: NDArray[np.float64],
) -> None:
    """Fill `around` by `neighbourhood_count`; apart from the decision, so that branch misses do not stall the loads."""
    for i in range(len(slots)):
        around[i] = neighbourhood_count(counts, np.uint64(slots[i]), slots_per_y, slots_per_x)


@kernel
def pick(
    counts: NDArray[np.uint32],
    slots: NDArray[np.uint32],
    keys: NDArray[np.uint32],
    asked: Asked,
    kept: NDArray[np.uint32],
    kept_counts: NDArray[np.uint32],
) -> int:
    """List the keys and counts of those `slots` that have the required counts; return their number."""
    around, own_needed, needed = asked
    # Unsigned, since numba tests a signed index for counting from the end.
    number = np.uint64(0)
    for i in range(len(slots)):
        own = counts[slots[i]]
        # Always written, and counted only if dense: a branch would be mispredicted too often.
        kept[number] = keys[i]
        kept_counts[number] = own
        number += np.uint64((own >= own_needed[i]) & (around[i] >= needed[i]))
    return np.int64(number)  # type: ignore[return-value]  # to numba it is a plain number


@kernel
def keep_dense(
    counts: NDArray[np.uint32], touched: NDArray[np.uint32], found: int, view: View, rule: Rule, kept: Kept
) -> int:
    """List the touched voxels that are dense enough in `kept`, in the order of `touched`; return their number.

    The first `found` entries of `touched` are slots of the counter with its rim. In ascending order, neighbours are in
    the cache.
    """
    view, rule, kept = View(*view), Rule(*rule), Kept(*kept)
    slots_per_y = np.uint64(view.shape[2] + 2)
    slots_per_x = slots_per_y * np.uint64(view.shape[1] + 2)
    share = min(rule.support_area_max_m2 / (view.voxel_size_m * view.voxel_size_m), 1.0)
    judged, keys = kept.judged, kept.judged_keys
    z_m, distance_m, full = judged[0], judged[1], judged[2]
    asked = Asked(judged[3], judged[4], judged[5])
    number = 0
    for first in range(0, found, AT_ONCE):
        slots = touched[first : min(first + AT_ONCE, found)]
        count = len(slots)
        locate(slots, view, keys, z_m, distance_m)
        if rule.angular:
            fill_angular(view, distance_m[:count], full)
        else:
            fill_pinhole(view, z_m[:count], full)
        demand(full[:count], rule, share, asked)
        sum_around(counts, slots, slots_per_y, slots_per_x, asked.around)
        number += pick(counts, slots, keys, asked, kept.keys[number:], kept.counts[number:])
    return number
