# SPDX-License-Identifier: Apache-2.0
"""How far the master's monotonic clock is from a unit's, from the messages that pass anyway (as NTP does).

One exchange has four times: the unit sends, the master receives, the master answers, the unit gets
the answer. The true offset lies within half the round trip around the middle, whatever the network
did; so the best exchange is the one with the shortest trip, and what it tells grows old only as fast
as two quartz clocks drift apart. Both sides use the same estimate: the master for the age of a view,
the unit for the robot's joints at the time of a frame.
"""

from __future__ import annotations

from typing import NamedTuple

DRIFT_PPM_MAX = 100
"""Two cheap quartz clocks, each off by up to 50 parts per million over temperature."""

RESOLUTION_NS = 1_000
"""What a time stamp can be off by itself; keeps a trip of no duration from being believed for ever."""


class Exchange(NamedTuple):
    """The four times of a request and its answer.

    `sent_ns` and `returned_ns` are by the unit's clock, `received_ns` and `answered_ns` by the master's.
    """

    sent_ns: int
    received_ns: int
    answered_ns: int
    returned_ns: int

    @property
    def offset_ns(self) -> int:
        """The master's clock less the unit's, in the middle of what is possible."""
        return (self.received_ns - self.sent_ns + self.answered_ns - self.returned_ns) // 2

    @property
    def uncertainty_ns(self) -> int:
        """How far the true offset can be from `offset_ns`: half the time that the messages were under way."""
        under_way_ns = (self.returned_ns - self.sent_ns) - (self.answered_ns - self.received_ns)
        return max(under_way_ns // 2, 0) + RESOLUTION_NS

    @property
    def possible(self) -> bool:
        """Whether neither clock ran backwards in it."""
        return self.returned_ns >= self.sent_ns and self.answered_ns >= self.received_ns


class ClockOffset:
    """The running estimate of the master's clock less the unit's: the shortest trip wins, and fades as clocks drift.

    A clock that jumped proves itself: the estimate and a new exchange then cannot both be true, and the
    new one is believed. Constant time and memory for each exchange.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._best: Exchange | None = None

    def add(self, exchange: Exchange) -> None:
        """Take one more exchange into account; an impossible one is passed over."""
        if not exchange.possible:
            return
        best = self._best
        if best is None:
            self._best = exchange
            return
        bound_ns = _bound_ns(best, exchange.returned_ns)
        if abs(exchange.offset_ns - best.offset_ns) > bound_ns + exchange.uncertainty_ns:
            self.jumps += 1
            self._best = exchange
        elif exchange.uncertainty_ns <= bound_ns:
            self._best = exchange

    @property
    def known(self) -> bool:
        """Whether there was any exchange yet."""
        return self._best is not None

    @property
    def offset_ns(self) -> int:
        """The master's clock less the unit's.

        Raises:
            LookupError: no exchange was added yet.
        """
        return self._known().offset_ns

    def uncertainty_ns(self, unit_now_ns: int) -> int:
        """How far `offset_ns` can be off at `unit_now_ns` of the unit's clock.

        Raises:
            LookupError: no exchange was added yet.
        """
        return _bound_ns(self._known(), unit_now_ns)

    def _known(self) -> Exchange:
        if self._best is None:
            raise LookupError("no exchange with the other clock yet")
        return self._best


def _bound_ns(exchange: Exchange, unit_now_ns: int) -> int:
    age_ns = abs(unit_now_ns - exchange.returned_ns)
    return exchange.uncertainty_ns + age_ns * DRIFT_PPM_MAX // 1_000_000
