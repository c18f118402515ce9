# SPDX-License-Identifier: Apache-2.0
"""How the robot moves: each joint swings about its home on sinusoids, so that all derivatives exist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.errors import InputError


@dataclass(frozen=True, eq=False)
class RobotPath:
    """Joint j stands at `home_rad[j] + sum_k amplitude_rad[k, j] * sin(2 pi k (t / period_s) + phase_rad[k, j])`.

    k counts from 1, so that everything repeats after `period_s`. Arrays: `home_rad` (n,), the others (K, n).
    """

    home_rad: NDArray[np.float64]
    amplitude_rad: NDArray[np.float64]
    phase_rad: NDArray[np.float64]
    period_s: float

    @classmethod
    def still(cls, joints_rad: ArrayLike) -> RobotPath:
        """A robot that stands at `joints_rad` (n,)."""
        home = np.array(joints_rad, dtype=np.float64)
        return cls(home, np.zeros((1, len(home))), np.zeros((1, len(home))), 1.0)

    @classmethod
    def demo(cls, speed: float = 1.0) -> RobotPath:
        """A UR3e over the demo cell's table: its tool moves at some 0.4 m/s, at most 1 m/s at `speed` 1.

        Raises:
            InputError: `speed` is not above 0.
        """
        if not speed > 0.0:
            raise InputError(f"speed: expected a factor above 0, got {speed}")
        return cls(_HOME_RAD, _AMPLITUDE_RAD, _PHASE_RAD, _PERIOD_S / speed)

    def joints_at(self, t_s: float) -> NDArray[np.float64]:
        """Joint positions (n,) in rad."""
        return np.asarray(self.home_rad + (self.amplitude_rad * np.sin(self._angles(t_s))).sum(axis=0))

    def velocities_at(self, t_s: float) -> NDArray[np.float64]:
        """Joint velocities (n,) in rad/s."""
        return np.asarray((self.amplitude_rad * self._rates() * np.cos(self._angles(t_s))).sum(axis=0))

    def _rates(self) -> NDArray[np.float64]:
        harmonics = np.arange(1, len(self.amplitude_rad) + 1)
        return np.asarray(2.0 * np.pi / self.period_s * harmonics[:, None])

    def _angles(self, t_s: float) -> NDArray[np.float64]:
        return np.asarray(self._rates() * (t_s % self.period_s) + self.phase_rad)


_PERIOD_S = 6.0

_HOME_RAD = np.array((-0.1, -1.45, 1.60, -1.75, -1.57, 0.0))

# Shoulder pan, shoulder lift, elbow, three wrists; harmonics 1 to 4 of the period.
_AMPLITUDE_RAD = np.array(
    (
        (0.75, 0.00, 0.10, 0.25, 0.00, 1.20),
        (0.30, 0.16, 0.00, 0.00, 0.30, 0.00),
        (0.12, 0.10, 0.22, 0.15, 0.00, 0.30),
        (0.00, 0.06, 0.10, 0.10, 0.15, 0.00),
    )
)
_PHASE_RAD = np.array(
    (
        (0.0, 0.0, 1.1, 0.4, 0.0, 0.9),
        (1.3, 0.2, 0.0, 0.0, 2.1, 0.0),
        (0.5, 2.0, 0.7, 2.6, 0.0, 1.7),
        (0.0, 1.0, 2.9, 0.3, 0.8, 0.0),
    )
)
