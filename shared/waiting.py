# SPDX-License-Identifier: Apache-2.0
"""Wait with a timeout without losing a cancellation, and call back at a time, by a clock that tests can replace.

`asyncio.wait_for` of Python 3.11 and older swallows a cancellation that arrives together with the result. A task that
waits thirty times a second then runs for ever although it was cancelled.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Generator
from functools import partial
from types import coroutine
from typing import Any, Protocol

from shared.clock import NS_PER_S, monotonic_ns


class Timer(Protocol):
    """A scheduled call."""

    def cancel(self) -> None:
        """Cancel the call."""


class Clock(Protocol):
    """A monotonic clock in nanoseconds with timers."""

    def now_ns(self) -> int:
        """Return the time in nanoseconds."""

    def call_at(self, at_ns: int, do: Callable[[], object]) -> Timer:
        """Schedule a call of `do` at this time, or at once when the time has passed."""


class LoopClock:
    """The machine's monotonic clock, with the timers of the running event loop."""

    def now_ns(self) -> int:
        """Return the time in nanoseconds."""
        return monotonic_ns()

    def call_at(self, at_ns: int, do: Callable[[], object]) -> Timer:
        """Schedule a call of `do` at this time, or at once when the time has passed."""
        return asyncio.get_running_loop().call_later(max(at_ns - monotonic_ns(), 0) / NS_PER_S, do)


LOOP_CLOCK = LoopClock()
"""The clock of everything that gets no other one."""


async def sleep(duration_s: float, clock: Clock) -> None:
    """Wait `duration_s` by `clock`."""
    over = asyncio.Event()
    timer = _call_after(duration_s, over.set, clock)
    try:
        await over.wait()
    finally:
        timer.cancel()


async def wait_set(event: asyncio.Event, timeout_s: float, clock: Clock) -> None:
    """Wait until `event` is set, and set it after `timeout_s` by `clock`.

    Cheaper than `within`: it takes one timer and no task.
    """
    timer = _call_after(timeout_s, event.set, clock)
    try:
        await event.wait()
    finally:
        timer.cancel()


async def done_within(timeout_s: float, future: asyncio.Future[Any], clock: Clock) -> bool:
    """Return True if `future` is done within `timeout_s` by `clock`; it goes on in either case."""
    late = asyncio.get_running_loop().create_future()
    timer = _call_after(timeout_s, partial(_end, late), clock)
    try:
        await asyncio.wait((future, late), return_when=asyncio.FIRST_COMPLETED)
    finally:
        timer.cancel()
    return future.done()


async def within(timeout_s: float, work: Coroutine[Any, Any, object], clock: Clock = LOOP_CLOCK) -> bool:
    """Return True if `work` is done within `timeout_s` by `clock`; cancel it if not. Its exceptions are raised."""
    task = asyncio.ensure_future(work)
    try:
        done = await done_within(timeout_s, task, clock)
    finally:
        task.cancel()
    if done:
        task.result()
    return done


def _call_after(duration_s: float, do: Callable[[], object], clock: Clock) -> Timer:
    return clock.call_at(clock.now_ns() + round(duration_s * NS_PER_S), do)


def _end(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


async def at_once_or_within(timeout_s: float, work: Coroutine[Any, Any, object]) -> bool:
    """Do the same as `within`, without a task or a turn of the event loop for work that does not wait at all.

    `work` runs in the caller's task up to its first wait.
    """
    try:
        waits_for = work.send(None)
    except StopIteration:
        return True
    return await within(timeout_s, _resumed(work, waits_for))


async def _resumed(work: Coroutine[Any, Any, object], waits_for: object) -> None:
    """Run the rest of `work` after its first wait."""
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
