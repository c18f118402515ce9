# SPDX-License-Identifier: Apache-2.0
"""The mean of many measurements of one pose, without outliers, and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.errors import InputError
from shared.transforms import Transform, from_rotation_translation

OUTLIER = 4.0
"""Robust standard deviations beyond which a measurement is left out."""

MAD_TO_SIGMA = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""

FLOOR_M = 2e-4
FLOOR_RAD = 1e-4
"""Measurements this close to each other are equal; repeated frames have no spread at all."""

ITERATIONS = 10
CONVERGED = 1e-10


@dataclass(frozen=True, eq=False)
class PoseMean:
    """A mean pose.

    Attributes:
        pose: (4, 4).
        used: (N,) the measurements in the mean.
            spread: (6, 6) covariance of a single measurement: position (m) in the reference frame, then rotation
                    (rad) in the moving one.
    """

    pose: Transform
    used: NDArray[np.bool_]
    spread: NDArray[np.float64]

    @property
    def spread_m(self) -> float:
        """Standard deviation of a single position."""
        return float(np.sqrt(np.trace(self.spread[:3, :3])))

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance (6, 6) of the mean, if the measurements are independent."""
        return self.spread / max(int(self.used.sum()), 1)


def mean_pose(poses: NDArray[np.float64]) -> PoseMean:
    """Return the mean of `poses` (N, 4, 4): arithmetic of positions, Karcher's of rotations.

    Raises:
        InputError: there is no pose.
    """
    if not len(poses):
        raise InputError("poses: expected at least one, got none")
    start = _most_central(poses)
    offsets = differences(poses[start], poses)
    far_m, far_rad = np.linalg.norm(offsets[:, :3], axis=1), np.linalg.norm(offsets[:, 3:], axis=1)
    used = (far_m <= _limit(far_m, FLOOR_M)) & (far_rad <= _limit(far_rad, FLOOR_RAD))
    pose = poses[start]
    for _ in range(ITERATIONS):
        step = differences(pose, poses[used]).mean(axis=0)
        pose = from_rotation_translation(pose[:3, :3] @ cv2.Rodrigues(step[3:])[0], pose[:3, 3] + step[:3])
        if np.abs(step).max() < CONVERGED:
            break
    offsets = differences(pose, poses[used])
    spread = offsets.T @ offsets / max(len(offsets) - 1, 1)
    return PoseMean(pose, used, spread)


def differences(pose: Transform, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 6) from `pose` to each of `poses` (N, 4, 4): position, then rotation vector in the frame of `pose`."""
    shifts = poses[:, :3, 3] - pose[:3, 3]
    turns = [cv2.Rodrigues(pose[:3, :3].T @ other[:3, :3])[0].ravel() for other in poses]
    return np.column_stack((shifts, np.array(turns)))


def _most_central(poses: NDArray[np.float64]) -> int:
    """Return the measurement that is closest to most others."""
    shifts = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    cosines = 0.5 * (np.einsum("aij,bij->ab", poses[:, :3, :3], poses[:, :3, :3]) - 1.0)
    turns = np.arccos(np.clip(cosines, -1.0, 1.0))
    # A metre counts as a radian: at a distance of 1 m both move the image by the same amount.
    return int(np.argmin(np.median(shifts + turns, axis=1)))


def _limit(distances: NDArray[np.float64], floor: float) -> float:
    return OUTLIER * max(MAD_TO_SIGMA * float(np.median(distances)), floor)
