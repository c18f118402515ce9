# SPDX-License-Identifier: Apache-2.0
"""Conversion of a camera's time stamps to this machine's CLOCK_MONOTONIC; follows the drift between the clocks.

Two facts limit the shift between the clocks. First, a frame never arrives before its capture, so the fastest frame
bounds the shift from above; its travel time stays unknown. Second, if the camera's clock can be read, a reading between
two of the unit's own gives the shift to within half the time that it took. The second is used as long as both agree,
as such readings are sometimes wrong by seconds on a crowded bus.

The SDK does the same with the wall clock. Here it is the monotonic clock, which is never set.
"""

from __future__ import annotations

from dataclasses import dataclass

from shared.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from shared.timebase import DRIFT_PPM_MAX, ClockOffset, Exchange

WRAP_NS = 2**32 * NS_PER_US
"""A RealSense counts microseconds in 32 bits: 71.6 minutes."""

LATENCY_MAX_NS = 300 * NS_PER_MS
"""An upper bound: the fastest of many frames never took longer from exposure to arrival."""

JUMP_NS = 50 * NS_PER_MS
"""If all frames are later than the fastest one by more than this, the camera's clock was set back ..."""

JUMP_CONFIRMED_NS = 5 * NS_PER_S
"""... when it lasts this long; under load alone, a fast frame comes now and then."""


class CameraClock:
    """Converts times of the camera to the unit's clock. Pure: the caller passes all times, and no clock is read.

    `latency_ns` is the assumed travel time of the fastest frame if the camera's clock cannot be read. `wraps` means
    that its clock restarts after `WRAP_NS`.
    """

    def __init__(self, latency_ns: int, *, wraps: bool = False) -> None:
        self._latency_ns = latency_ns
        self._wraps = wraps
        self._newest_ns: int | None = None
        self._fastest: _Fastest | None = None
        self._offset = ClockOffset()
        self._suspect: ClockOffset | None = None

    def compare(self, asked_ns: int, camera_ns: int, answered_ns: int) -> None:
        """Add a reading of the camera's clock, made between two readings of the unit's.

        A reading that contradicts all earlier ones counts only if the next one confirms it.
        """
        camera_ns = self._unwrapped(camera_ns)
        reading = Exchange(asked_ns, camera_ns, camera_ns, answered_ns)
        if self._offset.known and not _agree(reading, self._offset):
            suspect, self._suspect = self._suspect, ClockOffset()
            self._suspect.add(reading)
            if suspect is None or not _agree(reading, suspect):
                return
        self._suspect = None
        jumps = self._offset.jumps
        self._offset.add(reading)
        if self._offset.jumps > jumps:
            # Earlier frames do not describe the new setting of the clock.
            self._fastest = None

    def captured_at_ns(self, camera_ns: int, arrived_ns: int) -> int:
        """Return the capture time of a frame with stamp `camera_ns`, by the unit's clock; at most `arrived_ns`."""
        camera_ns = self._unwrapped(camera_ns)
        if self._fastest is None or self._newest_ns is None or camera_ns < self._newest_ns:
            # The first frame, or the clock restarted.
            self._fastest = _Fastest(arrived_ns - camera_ns, arrived_ns)
        self._newest_ns = camera_ns
        self._fastest.add(arrived_ns - camera_ns, arrived_ns)
        return min(camera_ns + self._shift_ns(arrived_ns), arrived_ns)

    @property
    def measured(self) -> bool:
        """True if the travel time from the camera is measured, not assumed."""
        return self._trusted_shift_ns() is not None

    def _shift_ns(self, arrived_ns: int) -> int:
        """The unit's clock less the camera's."""
        assert self._fastest is not None
        shift_ns = self._trusted_shift_ns()
        return self._fastest.shift_ns - self._latency_ns if shift_ns is None else shift_ns

    def _trusted_shift_ns(self) -> int | None:
        """Return the shift by the readings, if the fastest frame confirms them."""
        if self._fastest is None or not self._offset.known:
            return None
        slack_ns = self._offset.uncertainty_ns(self._fastest.at_ns)
        latency_ns = self._fastest.shift_ns + self._offset.offset_ns
        return -self._offset.offset_ns if -slack_ns <= latency_ns <= LATENCY_MAX_NS + slack_ns else None

    def _unwrapped(self, camera_ns: int) -> int:
        """Return the time with this counter that is closest to the newest one."""
        if not self._wraps or self._newest_ns is None:
            return camera_ns
        return camera_ns + round((self._newest_ns - camera_ns) / WRAP_NS) * WRAP_NS


@dataclass
class _Fastest:
    """The smallest shift seen; it ages as fast as two clocks can drift apart."""

    shift_ns: int
    at_ns: int
    late_since_ns: int | None = None
    late_shift_ns: int = 0

    def add(self, shift_ns: int, at_ns: int) -> None:
        drifted_ns = self.shift_ns + (at_ns - self.at_ns) * DRIFT_PPM_MAX // 1_000_000
        self.shift_ns, self.at_ns = min(drifted_ns, shift_ns), at_ns
        if shift_ns <= drifted_ns + JUMP_NS:
            self.late_since_ns = None
        elif self.late_since_ns is None:
            self.late_since_ns, self.late_shift_ns = at_ns, shift_ns
        else:
            self.late_shift_ns = min(self.late_shift_ns, shift_ns)
            if at_ns - self.late_since_ns >= JUMP_CONFIRMED_NS:
                self.shift_ns, self.late_since_ns = self.late_shift_ns, None


def _agree(reading: Exchange, known: ClockOffset) -> bool:
    slack_ns = reading.uncertainty_ns + known.uncertainty_ns(reading.returned_ns)
    return abs(reading.offset_ns - known.offset_ns) <= slack_ns
