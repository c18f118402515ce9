# SPDX-License-Identifier: Apache-2.0
"""The robot's joints at a frame's time, with their uncertainty."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.clock import NS_PER_MS, NS_PER_S
from shared.messages import JointSample

HISTORY_SAMPLES = 512
"""Four seconds at the master's rate of one sample in 8 ms; frames are far younger."""

ACCELERATION_MAX = 5.0
"""rad/s2 (or m/s2) that a robot at work is expected to reach; if it exceeds this it is reported as an obstacle."""

SPEED_MAX = 2.0
"""rad/s (or m/s) assumed while a joint's speed is not known."""

EXTRAPOLATION_MAX_S = 0.2
"""Beyond this span the padding would have to grow by 0.1 rad, and the robot would hide a person beside it."""

UNCERTAINTY_MAX = 0.1
"""rad (or m); with more uncertainty the robot is reported: its padding would hide a person beside it."""

CAPTURE_UNCERTAINTY_NS = 2 * NS_PER_MS
"""Exposure, and the path of a frame from the sensor to its time stamp."""

NEGLIGIBLE = 1e-3
"""rad (or m): a millimetre at a metre, well within the padding. A robot at rest is then not drawn anew."""

SPEED_SPAN_NS = 30 * NS_PER_MS
"""If the robot does not send a speed, it is fitted over at least this span, since samples have jitter: over 8 ms, a
sample that came 10 ms late would make the robot twice as fast."""

SPEED_SPAN_MIN_NS = 4 * NS_PER_MS
"""The shortest span to fit a speed over, while there are no older samples."""


@dataclass(frozen=True)
class JointEstimate:
    """Positions (n,) in rad (m where prismatic), and the uncertainty of each (n,)."""

    positions: NDArray[np.float64]
    uncertainty: NDArray[np.float64]


class JointHistory:
    """The last joint samples, all times by the master's clock."""

    def __init__(self) -> None:
        self._samples: deque[JointSample] = deque(maxlen=HISTORY_SAMPLES)

    def add(self, samples: Iterable[JointSample]) -> None:
        """Add samples, oldest first; known ones are skipped."""
        for sample in samples:
            if sample.at_ns > self.newest_ns:
                if self._samples and len(sample.positions) != len(self._samples[-1].positions):
                    self._samples.clear()
                self._samples.append(sample)

    def clear(self) -> None:
        """Remove all samples: another master has another clock."""
        self._samples.clear()

    @property
    def newest_ns(self) -> int:
        """Time of the newest sample; 0 if there is none."""
        return self._samples[-1].at_ns if self._samples else 0

    def at(self, at_ns: int, clock_uncertainty_ns: int, stale_after_s: float) -> JointEstimate | None:
        """Estimate the joints at `at_ns`; None if no sample is close enough in time.

        Between two samples it interpolates, with their velocities if the robot sends them. After the newest it
        extrapolates at the last speed. Both span at most `EXTRAPOLATION_MAX_S`. The possible effect of the robot's
        acceleration is added to the uncertainty; if that exceeds `UNCERTAINTY_MAX` the result is None.
        """
        newer: JointSample | None = None
        for sample in reversed(self._samples):
            if sample.at_ns <= at_ns:
                if newer is not None:
                    return _between(sample, newer, at_ns, clock_uncertainty_ns)
                return self._after(sample, at_ns, clock_uncertainty_ns, stale_after_s)
            newer = sample
        return None

    def _after(
        self, newest: JointSample, at_ns: int, clock_uncertainty_ns: int, stale_after_s: float
    ) -> JointEstimate | None:
        ahead_s = (at_ns - newest.at_ns) / NS_PER_S
        if ahead_s > min(stale_after_s, EXTRAPOLATION_MAX_S):
            return None
        velocity, velocity_off_by = self._velocity()
        drift = velocity_off_by * ahead_s + ACCELERATION_MAX * ahead_s**2 / 2.0
        positions = np.array(newest.positions) + velocity * ahead_s
        return _estimate(positions, np.abs(velocity), drift, clock_uncertainty_ns)

    def _velocity(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the newest sample's velocity (n,), as sent or fitted to the last samples, and its uncertainty."""
        newest = self._samples[-1]
        nothing = np.zeros(len(newest.positions))
        if newest.velocities is not None:
            return np.array(newest.velocities), nothing
        times_s, rows = [], []
        for sample in reversed(self._samples):
            times_s.append((sample.at_ns - newest.at_ns) / NS_PER_S)
            rows.append(sample.positions)
            if newest.at_ns - sample.at_ns >= SPEED_SPAN_NS:
                break
        span_s = -times_s[-1]
        if not SPEED_SPAN_MIN_NS / NS_PER_S <= span_s <= EXTRAPOLATION_MAX_S:
            return nothing, nothing + SPEED_MAX
        offset_s, positions = np.array(times_s) - np.mean(times_s), np.array(rows)
        # The fit is as old as the middle of its span; but a joint at rest had no speed to gain.
        most = np.minimum(0.5 * ACCELERATION_MAX * span_s, 4.0 * np.ptp(positions, axis=0) / span_s)
        return np.asarray(offset_s @ positions / (offset_s @ offset_s)), most


def _between(before: JointSample, after: JointSample, at_ns: int, clock_uncertainty_ns: int) -> JointEstimate | None:
    gap_s = (after.at_ns - before.at_ns) / NS_PER_S
    if gap_s > EXTRAPOLATION_MAX_S:
        return None
    first, last = np.array(before.positions), np.array(after.positions)
    share = (at_ns - before.at_ns) / (after.at_ns - before.at_ns)
    # A parabola of this acceleration is at most this far from its chord.
    bow = ACCELERATION_MAX * gap_s**2 / 8.0
    positions = first + share * (last - first)
    if before.velocities is None or after.velocities is None:
        return _estimate(positions, np.abs(last - first) / gap_s, bow, clock_uncertainty_ns)
    begins, ends = np.array(before.velocities), np.array(after.velocities)
    rest = 1.0 - share
    # Cubic Hermite interpolation: the chord, and the difference of the end velocities from it.
    chord = last - first
    positions += share * rest * (rest * (begins * gap_s - chord) - share * (ends * gap_s - chord))
    # With both end velocities known, a motion of this acceleration deviates half as far.
    return _estimate(positions, np.maximum(np.abs(begins), np.abs(ends)), 0.5 * bow, clock_uncertainty_ns)


def _estimate(
    positions: NDArray[np.float64],
    speed: NDArray[np.float64],
    drift: float | NDArray[np.float64],
    clock_uncertainty_ns: int,
) -> JointEstimate | None:
    """Return None if the positions are too uncertain to be of use."""
    time_s = (clock_uncertainty_ns + CAPTURE_UNCERTAINTY_NS) / NS_PER_S
    uncertainty = drift + speed * time_s
    if not (uncertainty <= UNCERTAINTY_MAX).all():
        return None
    return JointEstimate(positions, np.where(uncertainty < NEGLIGIBLE, 0.0, uncertainty))
