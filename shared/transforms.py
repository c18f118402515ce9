# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as (4, 4) float64 matrices.

`T_a_b` maps points of frame b into frame a, in metres, right-handed: `p_a = T_a_b @ p_b`, and so
`T_a_c = T_a_b @ T_b_c`. Camera frames are optical: x right, y down, z forward.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.errors import InputError

Transform: TypeAlias = NDArray[np.float64]

ROTATION_TOLERANCE = 2e-3
"""Largest deviation of `R @ R.T` from the identity; three decimals of each number leave it off by up to 1.7e-3."""

EXACT = 1e-12
"""A rotation with a smaller deviation stays as it is, digit by digit."""

NOTABLE_ROUNDING = 1e-5
"""A rotation with a larger correction had fewer than five decimals; points at 3 m are off by 0.05 mm or more."""

LAST_ROW_TOLERANCE = 1e-6
"""Largest deviation of the last row from 0 0 0 1; products and inverses in float32 are off by about 1e-7."""

_LAST_ROW = (0.0, 0.0, 0.0, 1.0)


def identity() -> Transform:
    """Return the identity transform."""
    return np.eye(4)


def validated(value: ArrayLike, name: str) -> Transform:
    """Return `value` as a (4, 4) float64 rigid transform: a copy whose last row is exactly 0 0 0 1.

    A rotation that is orthonormal but for the rounding of a printed matrix is replaced by the nearest one that is.

    Raises:
        InputError: `value` is not (4, 4) or not finite, its rotation is not orthonormal and right-handed, or its last
            row is off by more than rounding.
    """
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected a 4x4 matrix of numbers, got {type(value).__name__}") from error
    if matrix.shape != (4, 4):
        raise InputError(f"{name}: expected a 4x4 matrix, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InputError(f"{name}: expected finite numbers, got NaN or infinity")
    if np.abs(matrix[3] - _LAST_ROW).max() > LAST_ROW_TOLERANCE:
        raise InputError(f"{name}: expected the last row 0 0 0 1, got {matrix[3].tolist()}")
    matrix[3] = _LAST_ROW
    rotation = matrix[:3, :3]
    deviation = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if deviation > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise InputError(
            f"{name}: expected a right-handed rotation, got one that is off by {deviation:.2g} "
            f"with determinant {np.linalg.det(rotation):.3f}"
        )
    if deviation > EXACT:
        left, _, right = np.linalg.svd(rotation)
        matrix[:3, :3] = left @ right
    return matrix


def rounding_warning(value: ArrayLike, pose: Transform) -> str | None:
    """Return a sentence for a `value` whose rotation was notably rounded before `validated` made `pose` of it."""
    off_by = float(np.abs(np.asarray(value, dtype=np.float64)[:3, :3] - pose[:3, :3]).max())
    if off_by <= NOTABLE_ROUNDING:
        return None
    return f"its rotation has few decimals; the nearest one that is orthonormal is taken, {off_by:.1g} off"


def from_rotation_translation(rotation: ArrayLike, translation_m: ArrayLike) -> Transform:
    """Compose a transform from a (3, 3) rotation and a (3,) translation in metres."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation_m
    return matrix


def rotation_about(axis: ArrayLike, angle_rad: float) -> NDArray[np.float64]:
    """Return the (3, 3) rotation by `angle_rad` about `axis` (3,) of any length (Rodrigues)."""
    direction = np.asarray(axis, dtype=np.float64)
    norm = float(np.linalg.norm(direction))
    if norm == 0.0:
        return np.eye(3)
    x, y, z = direction / norm
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: NDArray[np.float64] = np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * (cross @ cross)
    return rotation


def from_xyz_rpy(xyz_m: ArrayLike, rpy_rad: ArrayLike) -> Transform:
    """Return the transform of a URDF origin: roll about x, pitch about y, yaw about z (fixed axes), then shift."""
    roll, pitch, yaw = np.asarray(rpy_rad, dtype=np.float64)
    rotation = (
        rotation_about((0.0, 0.0, 1.0), yaw)
        @ rotation_about((0.0, 1.0, 0.0), pitch)
        @ rotation_about((1.0, 0.0, 0.0), roll)
    )
    return from_rotation_translation(rotation, xyz_m)


def inverse(transform: Transform) -> Transform:
    """Return `T_b_a` of a rigid `T_a_b`."""
    rotation = transform[:3, :3].T
    return from_rotation_translation(rotation, -rotation @ transform[:3, 3])


def apply(transform: Transform, points_m: NDArray[Any]) -> NDArray[np.float64]:
    """Map points (..., 3) in metres from frame b into frame a by `T_a_b`."""
    return np.asarray(points_m @ transform[:3, :3].T + transform[:3, 3], dtype=np.float64)


def look_at(eye_m: ArrayLike, target_m: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Transform:
    """Return `T_world_camera` of an optical frame at `eye_m` whose z axis points at `target_m`.

    `up` is the world direction that points up in the image. For a view along `up`, world y replaces it; for a view
    along y as well, world z does.

    Raises:
        InputError: eye and target are the same point.
    """
    eye = np.asarray(eye_m, dtype=np.float64)
    forward = np.asarray(target_m, dtype=np.float64) - eye
    distance = float(np.linalg.norm(forward))
    if distance == 0.0:
        raise InputError("look_at: expected a target away from the eye, got the same point")
    forward = forward / distance
    for upward in (up, (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        right = np.cross(forward, np.asarray(upward, dtype=np.float64))
        if np.linalg.norm(right) >= 1e-6:
            break
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    return from_rotation_translation(np.column_stack((right, down, forward)), eye)


def angle_rad(transform: Transform) -> float:
    """Return the angle of the rotation in rad, 0 to pi."""
    rotation = transform[:3, :3]
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    # atan2 keeps its accuracy near 0 and pi, where acos of the trace loses it.
    return float(np.arctan2(np.linalg.norm(skew), np.trace(rotation) - 1.0))
