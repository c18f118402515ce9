# SPDX-License-Identifier: Apache-2.0
"""Poses of the links, and bounds of their errors (the paper's Algorithm 5).

The same computation as `shared.kinematics`, which explains it, in one call instead of fifty of numpy. Those would cost
a tenth of a millisecond a frame, and three times that in a cold cache. Arrays are those of
`shared.kinematics.LinkTable`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel


class Moving(NamedTuple):
    """The moving joints: the arrays of `shared.kinematics.LinkTable` over J."""

    parent: NDArray[np.int64]
    dof: NDArray[np.int64]
    multiplier: NDArray[np.float64]
    offset: NDArray[np.float64]
    is_turning: NDArray[np.bool_]
    axis: NDArray[np.float64]
    fixed: NDArray[np.float64]
    sine: NDArray[np.float64]
    versine: NDArray[np.float64]
    shift: NDArray[np.float64]


class Carried(NamedTuple):
    """The links on the joints: the arrays of `shared.kinematics.LinkTable` over L."""

    body: NDArray[np.int64]
    T_body_link: NDArray[np.float64]
    chain: NDArray[np.bool_]
    corners: NDArray[np.float64]


class Stand(NamedTuple):
    """Computed poses: `poses` (L, 4, 4) `T_camera_link`, and `bodies` (J + 1, 4, 4) `T_camera_body`, the base last.

    `local` (4, 4) is scratch.
    """

    poses: NDArray[np.float64]
    bodies: NDArray[np.float64]
    local: NDArray[np.float64]


@kernel
def multiply(a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Multiply two rigid transforms (4, 4)."""
    for i in range(3):
        for j in range(4):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j] + a[i, 3] * b[3, j]
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@kernel
def place_links(
    joints: NDArray[np.float64], T_camera_base: NDArray[np.float64], moving: Moving, carried: Carried, stand: Stand
) -> None:
    """Fill `stand` for joint positions (n,), rad or m."""
    moving, carried, stand = Moving(*moving), Carried(*carried), Stand(*stand)
    parent, dof, multiplier, offset, is_turning, _, fixed, sine, versine, shift = moving
    body, bodies, local = carried.body, stand.bodies, stand.local
    base = len(parent)
    bodies[base] = T_camera_base
    for k in range(base):
        value = multiplier[k] * joints[dof[k]] + offset[k]
        turn = value if is_turning[k] else 0.0
        sin, versin = math.sin(turn), 1.0 - math.cos(turn)
        for i in range(4):
            for j in range(4):
                local[i, j] = fixed[k, i, j] + sin * sine[k, i, j] + versin * versine[k, i, j] + value * shift[k, i, j]
        multiply(bodies[parent[k] if parent[k] >= 0 else base], local, bodies[k])
    for m in range(len(body)):
        multiply(bodies[body[m] if body[m] >= 0 else base], carried.T_body_link[m], stand.poses[m])


@kernel
def displace_links(
    uncertainty: NDArray[np.float64],
    moving: Moving,
    carried: Carried,
    stand: Stand,
    displacement_m: NDArray[np.float64],
) -> None:
    """Compute the largest motion (L,) of any point of each link for joint errors of `uncertainty` (n,), rad or m.

    `stand` was filled by `place_links`; see `shared.kinematics.Robot.displacement_m`.
    """
    moving, carried, stand = Moving(*moving), Carried(*carried), Stand(*stand)
    dof, multiplier, is_turning, axis = moving.dof, moving.multiplier, moving.is_turning, moving.axis
    chain, corners, poses, bodies = carried.chain, carried.corners, stand.poses, stand.bodies
    for m in range(len(poses)):
        displacement_m[m] = 0.0
        for k in range(len(dof)):
            if not chain[m, k]:
                continue
            off_by = uncertainty[dof[k]] * abs(multiplier[k])
            if not is_turning[k]:
                displacement_m[m] += off_by
                continue
            b, t = bodies[k], poses[m]
            axis_x = b[0, 0] * axis[k, 0] + b[0, 1] * axis[k, 1] + b[0, 2] * axis[k, 2]
            axis_y = b[1, 0] * axis[k, 0] + b[1, 1] * axis[k, 1] + b[1, 2] * axis[k, 2]
            axis_z = b[2, 0] * axis[k, 0] + b[2, 1] * axis[k, 1] + b[2, 2] * axis[k, 2]
            farthest_m2 = 0.0
            for n in range(8):
                p = corners[m, n]
                x = t[0, 0] * p[0] + t[0, 1] * p[1] + t[0, 2] * p[2] + t[0, 3] - b[0, 3]
                y = t[1, 0] * p[0] + t[1, 1] * p[1] + t[1, 2] * p[2] + t[1, 3] - b[1, 3]
                z = t[2, 0] * p[0] + t[2, 1] * p[1] + t[2, 2] * p[2] + t[2, 3] - b[2, 3]
                along = x * axis_x + y * axis_y + z * axis_z
                farthest_m2 = max(farthest_m2, x * x + y * y + z * z - along * along)
            displacement_m[m] += 2.0 * math.sin(min(off_by, math.pi) / 2.0) * math.sqrt(farthest_m2)
