# SPDX-License-Identifier: Apache-2.0
"""Tick a master by the clock, so that it notices what time alone changes without an update or a request."""

from __future__ import annotations

from master_server.core.master import Master
from shared.clock import NS_PER_MS
from shared.waiting import Clock, LoopClock, Timer

TICK_NS = 25 * NS_PER_MS
"""Half of the shortest `stale_after_s`; with 50 units a tick takes about 0.1 ms."""


class Ticker:
    """Ticks one master every `TICK_NS`."""

    def __init__(self, master: Master, clock: Clock | None = None) -> None:
        """By default, `clock` is that of the running event loop."""
        self._master = master
        self._clock = LoopClock() if clock is None else clock
        self._timer: Timer | None = None

    def start(self) -> None:
        """Start ticking."""
        self._tick()

    def stop(self) -> None:
        """Stop ticking."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        now_ns = self._clock.now_ns()
        # Schedule the next tick first: a fault below then costs only this tick.
        self._timer = self._clock.call_at(now_ns + TICK_NS, self._tick)
        self._master.tick(now_ns)
