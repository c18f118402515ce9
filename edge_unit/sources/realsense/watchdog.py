# SPDX-License-Identifier: Apache-2.0
"""Watchdog of the capture process: detects a stuck process and a silent stream, and decides on the restart.

Pure: the caller reports all events with their times, and acts on the answers.
"""

from __future__ import annotations

from dataclasses import dataclass

from edge_unit.sources.realsense.capture_link import PhaseName
from shared.clock import NS_PER_MS, NS_PER_S

PATIENCE_S: dict[PhaseName, float] = {
    "booting": 15.0,  # a small board that reads everything from a card
    "waiting": 10.0,  # the SDK may look for cameras for seconds
    "resetting": 25.0,
    "starting": 25.0,  # the SDK itself gives up after 15 s
    "streaming": 1.5,
    "stopping": 1.0,
}
"""Longest silence in each phase. Complete silence means that a call of the SDK does not return."""

SILENT_PERIODS = 4
SILENT_MIN_NS = 400 * NS_PER_MS
"""Without a frame for so many periods, and at least so long, a stream is silent; the master knows it within 1 s."""

BACK_OFF_S = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Back-off before the next process, by the number of failures in a row: at once first, then longer and longer."""

RESET_EVERY = 2
"""At every second failure in a row the camera's hardware is reset: it may help, and may need a restart itself."""

STEADY_NS = 10 * NS_PER_S
"""A stream that ran so long was healthy; a later failure counts as the first."""


@dataclass(frozen=True)
class Restart:
    """The start of the next process: after `delay_s`, with a hardware reset or without."""

    delay_s: float
    reset: bool


class Watchdog:
    """Watches one capture process after the other."""

    def __init__(self) -> None:
        self.phase: PhaseName = "booting"
        self.failures = 0
        self._heard_ns = 0
        self._frame_ns = 0
        self._streaming_ns: int | None = None
        self._period_ns = 0

    def begin(self, now_ns: int) -> None:
        """Record the start of a new process."""
        self.phase, self._heard_ns, self._streaming_ns = "booting", now_ns, None

    def note_message(self, now_ns: int, phase: PhaseName | None = None) -> None:
        """Record a message of the process; `phase` if it reported one."""
        self._heard_ns = now_ns
        self.phase = phase or self.phase

    def stream(self, now_ns: int, fps: int) -> None:
        """Expect frames from now on, so many a second."""
        self.note_message(now_ns, "streaming")
        self._streaming_ns = self._frame_ns = now_ns
        self._period_ns = NS_PER_S // max(fps, 1)

    def frame(self, now_ns: int) -> None:
        """Record a frame."""
        self.note_message(now_ns)
        self._frame_ns = now_ns

    def stuck_s(self, now_ns: int) -> float | None:
        """Return the length of the silence, if it is longer than this phase allows; the process is lost then."""
        quiet_s = (now_ns - self._heard_ns) / NS_PER_S
        return quiet_s if quiet_s > PATIENCE_S[self.phase] else None

    def silent_s(self, now_ns: int) -> float | None:
        """Return the time without a frame, if it is longer than expected."""
        if self._streaming_ns is None:
            return None
        quiet_ns = now_ns - self._frame_ns
        return quiet_ns / NS_PER_S if quiet_ns > max(SILENT_MIN_NS, SILENT_PERIODS * self._period_ns) else None

    def end(self, *, unplugged: bool = False) -> Restart:
        """Record an unwanted end of the process; `unplugged` means that nothing else is wrong with the camera."""
        if unplugged:
            return Restart(BACK_OFF_S[0], reset=False)
        if self._streaming_ns is not None and self._frame_ns - self._streaming_ns >= STEADY_NS:
            self.failures = 0
        delay_s = BACK_OFF_S[min(self.failures, len(BACK_OFF_S) - 1)]
        self.failures += 1
        # A camera that was never found cannot be reset.
        found = self.phase in ("starting", "streaming")
        return Restart(delay_s, found and self.failures % RESET_EVERY == 0)
