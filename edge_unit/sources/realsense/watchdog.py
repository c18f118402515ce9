# SPDX-License-Identifier: Apache-2.0
"""When a capture process counts as stuck, when its stream as silent, and how the next one is to begin.

Pure: it is told what was heard and when, and is asked; whoever asks does the killing.
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
"""How long nothing may be heard in each phase. Nothing at all means that a call of the SDK does not return."""

SILENT_PERIODS = 4
SILENT_MIN_NS = 400 * NS_PER_MS
"""Without a frame for so many periods, and at least so long, a stream is silent; the master hears of it within 1 s."""

BACK_OFF_S = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Before the next process, by how many went wrong in a row: at once first, then less and less eagerly."""

RESET_EVERY = 2
"""Every second time in a row the camera's hardware is reset: it may help, and may need a new beginning itself."""

STEADY_NS = 10 * NS_PER_S
"""A stream that ran so long was well; what goes wrong then is the first time."""


@dataclass(frozen=True)
class Restart:
    """How the next process begins: after `delay_s`, with a hardware reset or without."""

    delay_s: float
    reset: bool


class Watchdog:
    """Over one capture process after the other."""

    def __init__(self) -> None:
        self.phase: PhaseName = "booting"
        self.failures = 0
        self._heard_ns = 0
        self._frame_ns = 0
        self._streaming_ns: int | None = None
        self._period_ns = 0

    def begin(self, now_ns: int) -> None:
        """A new process was started."""
        self.phase, self._heard_ns, self._streaming_ns = "booting", now_ns, None

    def hear(self, now_ns: int, phase: PhaseName | None = None) -> None:
        """The process said something; `phase` if it told of one."""
        self._heard_ns = now_ns
        self.phase = phase or self.phase

    def stream(self, now_ns: int, fps: int) -> None:
        """Frames are to come from now on, so many a second."""
        self.hear(now_ns, "streaming")
        self._streaming_ns = self._frame_ns = now_ns
        self._period_ns = NS_PER_S // max(fps, 1)

    def frame(self, now_ns: int) -> None:
        """A frame came."""
        self.hear(now_ns)
        self._frame_ns = now_ns

    def stuck_s(self, now_ns: int) -> float | None:
        """For how long nothing was heard, if that is longer than this phase may be silent; the process is lost then."""
        quiet_s = (now_ns - self._heard_ns) / NS_PER_S
        return quiet_s if quiet_s > PATIENCE_S[self.phase] else None

    def silent_s(self, now_ns: int) -> float | None:
        """For how long no frame came, if that is longer than it should take."""
        if self._streaming_ns is None:
            return None
        quiet_ns = now_ns - self._frame_ns
        return quiet_ns / NS_PER_S if quiet_ns > max(SILENT_MIN_NS, SILENT_PERIODS * self._period_ns) else None

    def end(self, *, unplugged: bool = False) -> Restart:
        """The process ended, though nobody wanted it to; when the camera was `unplugged`, nothing is wrong with it."""
        if unplugged:
            return Restart(BACK_OFF_S[0], reset=False)
        if self._streaming_ns is not None and self._frame_ns - self._streaming_ns >= STEADY_NS:
            self.failures = 0
        delay_s = BACK_OFF_S[min(self.failures, len(BACK_OFF_S) - 1)]
        self.failures += 1
        # Where the camera was never found there is nothing to reset.
        found = self.phase in ("starting", "streaming")
        return Restart(delay_s, found and self.failures % RESET_EVERY == 0)
