# SPDX-License-Identifier: Apache-2.0
"""The robot's joints at a frame's time, and how far they may be off."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.clock import NS_PER_MS, NS_PER_S
from shared.messages import JointSample

HISTORY_SAMPLES = 512
"""Four seconds at one sample in 8 ms, which is what the master sends; frames are far younger."""

ACCELERATION_MAX = 5.0
"""rad/s2 (or m/s2) that a robot at work is expected to reach; what it does beyond is reported as an obstacle."""

SPEED_MAX = 2.0
"""rad/s (or m/s) allowed for while nothing is known of a joint's speed."""

EXTRAPOLATION_MAX_S = 0.2
"""Beyond, the padding would have to grow by 0.1 rad: the robot would hide whoever stands beside it."""

UNCERTAINTY_MAX = 0.1
"""rad (or m); a robot that may be anywhere within more is reported, for the padding would hide who stands by."""

CAPTURE_UNCERTAINTY_NS = 2 * NS_PER_MS
"""Exposure, and the path of a frame from the sensor to its time stamp."""

NEGLIGIBLE = 1e-3
"""rad (or m): a millimetre at a metre, well within the padding. A robot at rest then stays as it was drawn."""

SPEED_SPAN_NS = 30 * NS_PER_MS
"""A speed that the robot does not tell is fitted over at least this span, since samples come with jitter: over 8 ms,
one that came 10 ms late would make the robot twice as fast."""

SPEED_SPAN_MIN_NS = 4 * NS_PER_MS
"""Where there is no more yet, as long as this will do."""


@dataclass(frozen=True)
class JointEstimate:
    """Positions (n,) in rad (m where prismatic), and how far each may be off, (n,)."""

    positions: NDArray[np.float64]
    uncertainty: NDArray[np.float64]


class JointHistory:
    """The last few joint samples, all times by the master's clock."""

    def __init__(self) -> None:
        self._samples: deque[JointSample] = deque(maxlen=HISTORY_SAMPLES)

    def add(self, samples: Iterable[JointSample]) -> None:
        """Take in samples, oldest first; what is known already is passed over."""
        for sample in samples:
            if sample.at_ns > self.newest_ns:
                if self._samples and len(sample.positions) != len(self._samples[-1].positions):
                    self._samples.clear()
                self._samples.append(sample)

    def clear(self) -> None:
        """Forget all: another master has another clock."""
        self._samples.clear()

    @property
    def newest_ns(self) -> int:
        """Time of the newest sample; 0 when there is none."""
        return self._samples[-1].at_ns if self._samples else 0

    def at(self, at_ns: int, clock_uncertainty_ns: int, stale_after_s: float) -> JointEstimate | None:
        """Where the joints were at `at_ns`; None when nothing near enough in time is known.

        Between two samples it interpolates, with their velocities where the robot tells them; after the newest it goes
        on at the last speed; both over at most `EXTRAPOLATION_MAX_S`. What the robot's acceleration can change
        meanwhile is added to the uncertainty, and where that exceeds `UNCERTAINTY_MAX` nothing is known.
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
        """Of the newest sample (n,), as the robot tells it or fitted to the last few; and how far it may be off."""
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
        # The fit is as old as the middle of its span; but a joint that did not stir there had no speed to gain.
        most = np.minimum(0.5 * ACCELERATION_MAX * span_s, 4.0 * np.ptp(positions, axis=0) / span_s)
        return np.asarray(offset_s @ positions / (offset_s @ offset_s)), most


def _between(before: JointSample, after: JointSample, at_ns: int, clock_uncertainty_ns: int) -> JointEstimate | None:
    gap_s = (after.at_ns - before.at_ns) / NS_PER_S
    if gap_s > EXTRAPOLATION_MAX_S:
        return None
    first, last = np.array(before.positions), np.array(after.positions)
    share = (at_ns - before.at_ns) / (after.at_ns - before.at_ns)
    # A parabola of this acceleration is at most so far from its chord.
    bow = ACCELERATION_MAX * gap_s**2 / 8.0
    positions = first + share * (last - first)
    if before.velocities is None or after.velocities is None:
        return _estimate(positions, np.abs(last - first) / gap_s, bow, clock_uncertainty_ns)
    begins, ends = np.array(before.velocities), np.array(after.velocities)
    rest = 1.0 - share
    # Hermite's cubic: the chord, and what the velocities at its ends differ from it.
    chord = last - first
    positions += share * rest * (rest * (begins * gap_s - chord) - share * (ends * gap_s - chord))
    # What can leave and return at these velocities, at this acceleration, gets half as far.
    return _estimate(positions, np.maximum(np.abs(begins), np.abs(ends)), 0.5 * bow, clock_uncertainty_ns)


def _estimate(
    positions: NDArray[np.float64],
    speed: NDArray[np.float64],
    drift: float | NDArray[np.float64],
    clock_uncertainty_ns: int,
) -> JointEstimate | None:
    """None when the positions are too uncertain to be of use."""
    time_s = (clock_uncertainty_ns + CAPTURE_UNCERTAINTY_NS) / NS_PER_S
    uncertainty = drift + speed * time_s
    if not (uncertainty <= UNCERTAINTY_MAX).all():
        return None
    return JointEstimate(positions, np.where(uncertainty < NEGLIGIBLE, 0.0, uncertainty))
