# SPDX-License-Identifier: Apache-2.0
"""The report that is sent next: a slot of one, so that a slow network costs frames and never delay."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from edge_unit.uplink.assignment import Delivery, Report
from shared.waiting import LOOP_CLOCK, Clock, wait_set, within

logger = logging.getLogger(__name__)

HEARTBEAT_S = 0.2
"""Without a new frame the last report is sent again, often enough for the shortest sensible staleness."""


class Outbox:
    """Latest-only.

    Attributes:
        last: the report that was sent last, to be sent again while no new one comes.
    """

    def __init__(self, on_sent: Callable[[Report, Delivery | None], None], clock: Clock = LOOP_CLOCK) -> None:
        """Call `on_sent` for each report with its delivery, or with None if it never reached the master."""
        self._on_sent = on_sent
        self._clock = clock
        self.last: Report | None = None
        self._fresh: Report | None = None
        self._wake = asyncio.Event()
        self._idle = asyncio.Event()
        self._idle.set()

    @property
    def empty(self) -> bool:
        """True while nothing new is to be sent."""
        return self._fresh is None

    def offer(self, report: Report) -> None:
        """Send this next; what was offered before and not sent yet is dropped."""
        if self._fresh is not None:
            self._on_sent(self._fresh, None)
        self._fresh = report
        self._idle.clear()
        self._wake.set()

    def take(self) -> Report | None:
        """Return what was offered, which is out of the slot then."""
        fresh, self._fresh = self._fresh, None
        return fresh

    def sent(self, report: Report, delivery: Delivery | None) -> None:
        """Tell of a report that was taken how it reached the master, or None: it never did."""
        self._on_sent(report, delivery)

    def put_back(self, report: Report | None) -> None:
        """Try again what could not be sent, unless a newer one came meanwhile."""
        if self._fresh is None:
            self._fresh = report
        elif report is not None:
            self._on_sent(report, None)

    def drop(self) -> None:
        """Send nothing of what was offered."""
        if self._fresh is not None:
            self._on_sent(self._fresh, None)
            self._fresh = None
        self._idle.set()

    def settle(self) -> None:
        """Note that an exchange ended: with nothing new, all is sent."""
        if self._fresh is None:
            self._idle.set()

    def wake(self) -> None:
        """End the wait for something to be sent."""
        self._wake.set()

    async def woken(self, *, heartbeat: bool = True) -> None:
        """Wait until something is to be sent, with `heartbeat` no longer than until the next one."""
        self._wake.clear()
        if heartbeat:
            await wait_set(self._wake, HEARTBEAT_S, self._clock)
        else:
            await self._wake.wait()

    async def drained(self, timeout_s: float) -> None:
        """Wait until nothing is left to be sent, but no longer than `timeout_s`."""
        if not await within(timeout_s, self._idle.wait(), self._clock):
            logger.warning("the last frame did not reach the master")
