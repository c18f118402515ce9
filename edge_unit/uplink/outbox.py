# SPDX-License-Identifier: Apache-2.0
"""The next report: a queue of one, so that a slow network drops frames and adds no delay."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from edge_unit.uplink.assignment import Delivery, Report
from shared.waiting import LOOP_CLOCK, Clock, wait_set, within

logger = logging.getLogger(__name__)

HEARTBEAT_S = 0.2
"""Interval in which the last report is sent again without a new frame; shorter than any useful limit of age."""


class Outbox:
    """A latest-only queue of one report.

    Attributes:
        last: the report that was sent last; it is sent again while there is no new one.
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
        """True if there is no new report."""
        return self._fresh is None

    def offer(self, report: Report) -> None:
        """Send this report next; an earlier one that was not sent yet is dropped."""
        if self._fresh is not None:
            self._on_sent(self._fresh, None)
        self._fresh = report
        self._idle.clear()
        self._wake.set()

    def take(self) -> Report | None:
        """Take the report out of the queue."""
        fresh, self._fresh = self._fresh, None
        return fresh

    def sent(self, report: Report, delivery: Delivery | None) -> None:
        """Note the delivery of a report that was taken, or None if it did not reach the master."""
        self._on_sent(report, delivery)

    def put_back(self, report: Report | None) -> None:
        """Put a report back that could not be sent, unless there is a newer one."""
        if self._fresh is None:
            self._fresh = report
        elif report is not None:
            self._on_sent(report, None)

    def drop(self) -> None:
        """Drop the report."""
        if self._fresh is not None:
            self._on_sent(self._fresh, None)
            self._fresh = None
        self._idle.set()

    def settle(self) -> None:
        """Note that an exchange ended; without a new report everything is sent."""
        if self._fresh is None:
            self._idle.set()

    def wake(self) -> None:
        """End a wait for a report."""
        self._wake.set()

    async def woken(self, *, heartbeat: bool = True) -> None:
        """Wait for a report; with `heartbeat` no longer than until the next heartbeat."""
        self._wake.clear()
        if heartbeat:
            await wait_set(self._wake, HEARTBEAT_S, self._clock)
        else:
            await self._wake.wait()

    async def drained(self, timeout_s: float) -> None:
        """Wait until everything is sent, but no longer than `timeout_s`."""
        if not await within(timeout_s, self._idle.wait(), self._clock):
            logger.warning("the last frame did not reach the master")
