# SPDX-License-Identifier: Apache-2.0
"""A clock that a test sets."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

S = 1_000_000_000
MS = 1_000_000
START_NS = 10_000_000 * S
"""The first time of a clock that is set."""


@dataclass(eq=False)
class SetTimer:
    """A call that a `SetClock` makes when its time has come."""

    at_ns: int
    do: Callable[[], object]
    cancelled: bool = False

    def cancel(self) -> None:
        self.cancelled = True


@dataclass
class SetClock:
    """A clock that goes on only when it is told to, and then makes the calls that are due in their order."""

    now: int = START_NS
    timers: list[SetTimer] = field(default_factory=list)
    added: asyncio.Event = field(default_factory=asyncio.Event)

    def now_ns(self) -> int:
        return self.now

    def call_at(self, at_ns: int, do: Callable[[], object]) -> SetTimer:
        self.timers.append(SetTimer(at_ns, do))
        self.added.set()
        return self.timers[-1]

    def due_ns(self) -> int | None:
        """Time of the next scheduled call; None if there is none."""
        self.timers = [timer for timer in self.timers if not timer.cancelled]
        return min((timer.at_ns for timer in self.timers), default=None)

    def go_to(self, now_ns: int) -> None:
        """Go on to this time."""
        while (due_ns := self.due_ns()) is not None and due_ns <= now_ns:
            timer = min(self.timers, key=lambda timer: timer.at_ns)
            self.timers.remove(timer)
            self.now = max(self.now, timer.at_ns)
            timer.do()
        self.now = max(self.now, now_ns)

    def step(self) -> int:
        """Go on to the next call that is due, and return its time."""
        due_ns = self.due_ns()
        assert due_ns is not None
        self.go_to(due_ns)
        return self.now

    async def waited_for(self) -> int:
        """Wait until a call is due at some time, and return that time."""
        while (due_ns := self.due_ns()) is None:
            self.added.clear()
            await self.added.wait()
        return due_ns
