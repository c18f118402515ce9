# SPDX-License-Identifier: Apache-2.0
"""A camera's time stamps on this machine's CLOCK_MONOTONIC, its drift followed.

Two things are known of the shift between the clocks. A frame never arrives before it is taken, so the frame that
arrived fastest bounds the shift from above; how long that fastest frame was under way, it does not tell. And where
the camera's clock can be read, a reading between two of ours tells the shift to within half the time it took. The
second is used as long as both agree, for such readings are sometimes wrong by seconds on a crowded bus.

The SDK does the like with the wall clock; we do it with the monotonic one, which is never set.
"""

from __future__ import annotations

from dataclasses import dataclass

from shared.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from shared.timebase import DRIFT_PPM_MAX, ClockOffset, Exchange

WRAP_NS = 2**32 * NS_PER_US
"""A RealSense counts microseconds in 32 bits: 71.6 minutes."""

LATENCY_MAX_NS = 300 * NS_PER_MS
"""More than the fastest of many frames was ever seen to take from exposure to our hands."""

JUMP_NS = 50 * NS_PER_MS
"""Frames all later than the fastest one by more than this speak of a clock that was set back ..."""

JUMP_CONFIRMED_NS = 5 * NS_PER_S
"""... when it lasts so long; load alone lets a fast one through now and then."""


class CameraClock:
    """Where a time of the camera lies on our clock. Pure: it is told all times, and reads none itself.

    `latency_ns` is what the fastest frame is taken to need when the camera's clock cannot be read. `wraps` tells that
    its clock begins anew after `WRAP_NS`.
    """

    def __init__(self, latency_ns: int, *, wraps: bool = False) -> None:
        self._latency_ns = latency_ns
        self._wraps = wraps
        self._newest_ns: int | None = None
        self._fastest: _Fastest | None = None
        self._offset = ClockOffset()
        self._suspect: ClockOffset | None = None

    def compare(self, asked_ns: int, camera_ns: int, answered_ns: int) -> None:
        """Take in a reading of the camera's clock that was made between two readings of ours.

        A reading that contradicts all before it is believed only when the next one bears it out.
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
            # Frames of before tell nothing of the clock as it is set now.
            self._fastest = None

    def captured_at_ns(self, camera_ns: int, arrived_ns: int) -> int:
        """When a frame with the camera's stamp `camera_ns` was taken, by our clock; never after `arrived_ns`."""
        camera_ns = self._unwrapped(camera_ns)
        if self._fastest is None or self._newest_ns is None or camera_ns < self._newest_ns:
            # The first frame, or a clock that began anew.
            self._fastest = _Fastest(arrived_ns - camera_ns, arrived_ns)
        self._newest_ns = camera_ns
        self._fastest.add(arrived_ns - camera_ns, arrived_ns)
        return min(camera_ns + self._shift_ns(arrived_ns), arrived_ns)

    @property
    def measured(self) -> bool:
        """Whether the way from the camera to us is measured, not assumed."""
        return self._trusted_shift_ns() is not None

    def _shift_ns(self, arrived_ns: int) -> int:
        """Our clock less the camera's."""
        assert self._fastest is not None
        shift_ns = self._trusted_shift_ns()
        return self._fastest.shift_ns - self._latency_ns if shift_ns is None else shift_ns

    def _trusted_shift_ns(self) -> int | None:
        """As the readings tell, where the fastest frame bears them out."""
        if self._fastest is None or not self._offset.known:
            return None
        slack_ns = self._offset.uncertainty_ns(self._fastest.at_ns)
        latency_ns = self._fastest.shift_ns + self._offset.offset_ns
        return -self._offset.offset_ns if -slack_ns <= latency_ns <= LATENCY_MAX_NS + slack_ns else None

    def _unwrapped(self, camera_ns: int) -> int:
        """The time whose counter this is that lies nearest to the newest one."""
        if not self._wraps or self._newest_ns is None:
            return camera_ns
        return camera_ns + round((self._newest_ns - camera_ns) / WRAP_NS) * WRAP_NS


@dataclass
class _Fastest:
    """The smallest shift seen, forgotten as fast as two clocks can drift apart."""

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
