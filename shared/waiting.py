# SPDX-License-Identifier: Apache-2.0
"""Waiting with a limit, without losing a cancellation; and being called at a time, by a clock that tests may set.

`asyncio.wait_for` of Python 3.11 and older swallows a cancellation that arrives together with what is waited for; a
task that is woken thirty times a second then goes on for ever although it was told to end.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Generator
from types import coroutine
from typing import Any, Protocol

from shared.clock import NS_PER_S, monotonic_ns


class Timer(Protocol):
    """A call that is still to come."""

    def cancel(self) -> None:
        """It does not come."""


class Clock(Protocol):
    """A monotonic clock in nanoseconds that also calls back."""

    def now_ns(self) -> int:
        """The time."""

    def call_at(self, at_ns: int, do: Callable[[], object]) -> Timer:
        """Have `do` called at this time, or soon when it is past."""


class LoopClock:
    """The machine's monotonic clock, with the timers of the event loop that runs."""

    def now_ns(self) -> int:
        """The time."""
        return monotonic_ns()

    def call_at(self, at_ns: int, do: Callable[[], object]) -> Timer:
        """Have `do` called at this time, or soon when it is past."""
        return asyncio.get_running_loop().call_later(max(at_ns - monotonic_ns(), 0) / NS_PER_S, do)


async def within(timeout_s: float, work: Coroutine[Any, Any, object]) -> bool:
    """Whether `work` was done within `timeout_s`; what is not is cancelled. Its exceptions are raised."""
    task = asyncio.ensure_future(work)
    try:
        done, _ = await asyncio.wait((task,), timeout=timeout_s)
    finally:
        task.cancel()
    if done:
        task.result()
    return bool(done)


async def at_once_or_within(timeout_s: float, work: Coroutine[Any, Any, object]) -> bool:
    """As `within`, for work that mostly need not wait at all: it then costs neither a task nor a turn of the loop.

    Up to its first wait, `work` runs in the caller's task.
    """
    try:
        waits_for = work.send(None)
    except StopIteration:
        return True
    return await within(timeout_s, _resumed(work, waits_for))


async def _resumed(work: Coroutine[Any, Any, object], waits_for: object) -> None:
    """The rest of `work`, which has come to its first wait."""
    await _steps(work, waits_for)


@coroutine
def _steps(work: Coroutine[Any, Any, object], waits_for: object) -> Generator[object, Any, None]:
    try:
        while True:
            try:
                value = yield waits_for
            except BaseException as error:
                waits_for = work.throw(error)
            else:
                waits_for = work.send(value)
    except StopIteration:
        return
