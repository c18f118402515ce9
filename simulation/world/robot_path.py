# SPDX-License-Identifier: Apache-2.0
"""Motion of the robot: on sinusoids, so that all derivatives exist, or at full speed with sharp reversals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.errors import InputError


class JointPath(Protocol):
    """Joint positions over time; `home_rad` (n,) is the centre of the motion."""

    @property
    def home_rad(self) -> NDArray[np.float64]:
        """Centre of the motion (n,) in rad."""
        ...

    def joints_at(self, t_s: float) -> NDArray[np.float64]:
        """Return joint positions (n,) in rad."""
        ...

    def velocities_at(self, t_s: float) -> NDArray[np.float64]:
        """Return joint velocities (n,) in rad/s."""
        ...


@dataclass(frozen=True, eq=False)
class RobotPath:
    """Joint j is at `home_rad[j] + sum_k amplitude_rad[k, j] * sin(2 pi k (t / period_s) + phase_rad[k, j])`.

    k counts from 1, so that everything repeats after `period_s`. Arrays: `home_rad` (n,), the others (K, n).
    """

    home_rad: NDArray[np.float64]
    amplitude_rad: NDArray[np.float64]
    phase_rad: NDArray[np.float64]
    period_s: float

    @classmethod
    def still(cls, joints_rad: ArrayLike) -> RobotPath:
        """Return the path of a robot at rest at `joints_rad` (n,)."""
        home = np.array(joints_rad, dtype=np.float64)
        return cls(home, np.zeros((1, len(home))), np.zeros((1, len(home))), 1.0)

    @classmethod
    def demo(cls, speed: float = 1.0) -> RobotPath:
        """Return a path of a UR3e over the demo cell's table; its tool moves at about 0.4 m/s, at most 1 m/s.

        These speeds are for `speed` 1.

        Raises:
            InputError: `speed` is not above 0.
        """
        if not speed > 0.0:
            raise InputError(f"speed: expected a factor above 0, got {speed}")
        return cls(_HOME_RAD, _AMPLITUDE_RAD, _PHASE_RAD, _PERIOD_S / speed)

    def joints_at(self, t_s: float) -> NDArray[np.float64]:
        """Return joint positions (n,) in rad."""
        return np.asarray(self.home_rad + (self.amplitude_rad * np.sin(self._angles(t_s))).sum(axis=0))

    def velocities_at(self, t_s: float) -> NDArray[np.float64]:
        """Return joint velocities (n,) in rad/s."""
        return np.asarray((self.amplitude_rad * self._rates() * np.cos(self._angles(t_s))).sum(axis=0))

    def _rates(self) -> NDArray[np.float64]:
        harmonics = np.arange(1, len(self.amplitude_rad) + 1)
        return np.asarray(2.0 * np.pi / self.period_s * harmonics[:, None])

    def _angles(self, t_s: float) -> NDArray[np.float64]:
        return np.asarray(self._rates() * (t_s % self.period_s) + self.phase_rad)


@dataclass(frozen=True, eq=False)
class ShuttlePath:
    """Each joint moves between `home_rad - reach_rad` and `home_rad + reach_rad` with a trapezoidal speed profile.

    It accelerates at `acceleration_rad_s2`, moves at `speed_rad_s`, decelerates equally, and reverses without a pause.
    Arrays (n,); a joint without reach is at rest.
    """

    home_rad: NDArray[np.float64]
    reach_rad: NDArray[np.float64]
    speed_rad_s: NDArray[np.float64]
    acceleration_rad_s2: float

    def joints_at(self, t_s: float) -> NDArray[np.float64]:
        """Return joint positions (n,) in rad."""
        way, t, forth, ramp_s, stroke_s = self._stroke(t_s)
        ramp = 0.5 * self.acceleration_rad_s2 * ramp_s
        a = 0.5 * self.acceleration_rad_s2
        gone = np.where(
            t < ramp_s,
            a * t**2,
            np.where(t < stroke_s - ramp_s, ramp * (2.0 * t - ramp_s), way - a * (stroke_s - t) ** 2),
        )
        return np.asarray(self.home_rad + np.where(forth, gone - 0.5 * way, 0.5 * way - gone))

    def velocities_at(self, t_s: float) -> NDArray[np.float64]:
        """Return joint velocities (n,) in rad/s."""
        _, t, forth, ramp_s, stroke_s = self._stroke(t_s)
        speed = self.acceleration_rad_s2 * np.minimum(np.minimum(t, stroke_s - t), ramp_s)
        return np.asarray(np.where(forth, speed, -speed))

    def _stroke(
        self, t_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
        """Return for each joint (n,): distance, time within it, direction, and the times of a ramp and a stroke."""
        way = 2.0 * self.reach_rad
        # If the distance is too short for full speed, it consists of ramps only.
        top = np.minimum(self.speed_rad_s, np.sqrt(way * self.acceleration_rad_s2))
        ramp_s = top / self.acceleration_rad_s2
        stroke_s = ramp_s + np.divide(way, top, out=np.ones_like(way), where=top > 0.0)
        t = np.asarray(t_s % (2.0 * stroke_s))
        forth = np.asarray(t < stroke_s)
        return way, np.where(forth, t, t - stroke_s), forth, ramp_s, stroke_s


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
