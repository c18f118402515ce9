# SPDX-License-Identifier: Apache-2.0
"""The report that is sent next. The outbox holds one report, so a slow network drops frames and adds no delay."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from edge_unit.uplink.assignment import Delivery, Report
from shared.waiting import LOOP_CLOCK, Clock, wait_set, within

logger = logging.getLogger(__name__)

HEARTBEAT_S = 0.2
"""Interval at which the last report is sent again without a new frame: short enough for the shortest useful timeout
after which a unit is stale."""


class Outbox:
    """A latest-only queue of one report.

    Attributes:
        last: the report that was sent last, and is sent again while there is no new one.
    """

    def __init__(self, on_sent: Callable[[Report, Delivery | None], None], clock: Clock = LOOP_CLOCK) -> None:
        """Set `on_sent`, which is called for each report with its delivery, or with None if the report was dropped."""
        self._on_sent = on_sent
        self._clock = clock
        self.last: Report | None = None
        self._fresh: Report | None = None
        self._wake = asyncio.Event()
        self._idle = asyncio.Event()
        self._idle.set()

    @property
    def empty(self) -> bool:
        """Return True if there is no new report to send."""
        return self._fresh is None

    def offer(self, report: Report) -> None:
        """Send `report` next. An earlier report that is not sent yet is dropped."""
        if self._fresh is not None:
            self._on_sent(self._fresh, None)
        self._fresh = report
        self._idle.clear()
        self._wake.set()

    def take(self) -> Report | None:
        """Remove and return the offered report, or None."""
        fresh, self._fresh = self._fresh, None
        return fresh

    def sent(self, report: Report, delivery: Delivery | None) -> None:
        """Call `on_sent` for a report that was taken. `delivery` is None if it did not reach the master."""
        self._on_sent(report, delivery)

    def put_back(self, report: Report | None) -> None:
        """Send `report` again, unless a newer report was offered since."""
        if self._fresh is None:
            self._fresh = report
        elif report is not None:
            self._on_sent(report, None)

    def drop(self) -> None:
        """Drop the offered report."""
        if self._fresh is not None:
            self._on_sent(self._fresh, None)
            self._fresh = None
        self._idle.set()

    def settle(self) -> None:
        """Note the end of an exchange. If there is no new report, all reports are sent."""
        if self._fresh is None:
            self._idle.set()

    def wake(self) -> None:
        """End a wait in `woken`."""
        self._wake.set()

    async def woken(self, *, heartbeat: bool = True) -> None:
        """Wait until there is a report to send, with `heartbeat` at most `HEARTBEAT_S`."""
        self._wake.clear()
        if heartbeat:
            await wait_set(self._wake, HEARTBEAT_S, self._clock)
        else:
            await self._wake.wait()

    async def drained(self, timeout_s: float) -> None:
        """Wait until all reports are sent, at most `timeout_s`."""
        if not await within(timeout_s, self._idle.wait(), self._clock):
            logger.warning("the last frame did not reach the master")
