# SPDX-License-Identifier: Apache-2.0
"""Offset between the master's and a unit's monotonic clock, estimated from the regular messages as in NTP.

One exchange has four times: the unit sends, the master receives, the master answers, the unit receives the answer.
The true offset lies within half the round trip around the middle, for any network delays. So the exchange with the
shortest round trip is the best one, and its bound grows only as fast as two quartz clocks drift apart. Both sides use
the same estimate: the master for the age of a view, the unit for the robot's joints at the time of a frame.
"""

from __future__ import annotations

from typing import NamedTuple

DRIFT_PPM_MAX = 100
"""Drift between two cheap quartz clocks, each off by up to 50 parts per million over temperature."""

RESOLUTION_NS = 1_000
"""Error of a time stamp itself; without it, an exchange with a round trip of zero would stay the best for ever."""


class Exchange(NamedTuple):
    """The four times of a request and its answer.

    `sent_ns` and `returned_ns` are on the unit's clock, `received_ns` and `answered_ns` on the master's.
    """

    sent_ns: int
    received_ns: int
    answered_ns: int
    returned_ns: int

    @property
    def offset_ns(self) -> int:
        """The master's clock less the unit's: the middle of the possible interval."""
        return (self.received_ns - self.sent_ns + self.answered_ns - self.returned_ns) // 2

    @property
    def uncertainty_ns(self) -> int:
        """Largest possible error of `offset_ns`: half the time that the messages travelled, and the resolution."""
        travel_ns = (self.returned_ns - self.sent_ns) - (self.answered_ns - self.received_ns)
        return max(travel_ns // 2, 0) + RESOLUTION_NS

    @property
    def possible(self) -> bool:
        """True if neither clock ran backwards during the exchange."""
        return self.returned_ns >= self.sent_ns and self.answered_ns >= self.received_ns


class ClockOffset:
    """Running estimate of the master's clock less the unit's; it keeps the exchange with the smallest bound.

    The bound of an exchange grows with its age by the drift. After a jump of a clock, the estimate and a new exchange
    contradict each other: the new one replaces the estimate. Time and memory for each exchange are constant.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._best: Exchange | None = None

    def add(self, exchange: Exchange) -> None:
        """Add an exchange; ignore an impossible one."""
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
        """True after the first exchange."""
        return self._best is not None

    @property
    def offset_ns(self) -> int:
        """The master's clock less the unit's, in nanoseconds.

        Raises:
            LookupError: there was no exchange yet.
        """
        return self._known().offset_ns

    def uncertainty_ns(self, unit_now_ns: int) -> int:
        """Return the largest possible error of `offset_ns` at `unit_now_ns` of the unit's clock.

        Raises:
            LookupError: there was no exchange yet.
        """
        return _bound_ns(self._known(), unit_now_ns)

    def _known(self) -> Exchange:
        if self._best is None:
            raise LookupError("no exchange with the other clock yet")
        return self._best


def _bound_ns(exchange: Exchange, unit_now_ns: int) -> int:
    age_ns = abs(unit_now_ns - exchange.returned_ns)
    return exchange.uncertainty_ns + age_ns * DRIFT_PPM_MAX // 1_000_000
