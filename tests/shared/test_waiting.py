# SPDX-License-Identifier: Apache-2.0
"""Waiting with a timeout."""

from __future__ import annotations

import asyncio

import pytest

from shared.waiting import at_once_or_within, done_within, sleep, wait_set, within
from tests.set_clock import START_NS, S, SetClock

pytestmark = pytest.mark.alone


async def test_within_returns_whether_the_work_finished() -> None:
    event = asyncio.Event()
    assert not await within(0.01, event.wait())
    event.set()
    assert await within(0.01, event.wait())


async def test_work_that_does_not_wait_runs_in_the_task_of_the_caller() -> None:
    ran_in: list[asyncio.Task[object] | None] = []
    event = asyncio.Event()

    async def work() -> None:
        ran_in.append(asyncio.current_task())
        await event.wait()
        ran_in.append(asyncio.current_task())

    event.set()
    assert await at_once_or_within(0.01, work())
    assert ran_in == [asyncio.current_task()] * 2


async def test_work_that_waits_continues_at_its_first_wait() -> None:
    first, second = asyncio.Event(), asyncio.Event()
    done: list[str] = []

    async def work() -> None:
        await first.wait()
        done.append("first")
        await second.wait()
        done.append("second")

    loop = asyncio.get_running_loop()
    loop.call_soon(first.set)
    loop.call_later(0.01, second.set)
    assert await at_once_or_within(1.0, work())
    assert done == ["first", "second"]


@pytest.mark.parametrize("waits", [False, True])
async def test_errors_are_raised_at_once_and_later(waits: bool) -> None:
    async def fail() -> None:
        await asyncio.sleep(0.01 * waits)
        raise LookupError("nothing there")

    with pytest.raises(LookupError, match="nothing there"):
        await at_once_or_within(1.0, fail())


async def test_work_is_cancelled_at_its_wait_after_the_timeout() -> None:
    cancelled = asyncio.Event()

    async def work() -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            cancelled.set()
            raise

    assert not await at_once_or_within(0.01, work())
    await asyncio.sleep(0)
    assert cancelled.is_set()


async def test_errors_are_raised() -> None:
    async def fail() -> None:
        raise LookupError("nothing there")

    with pytest.raises(LookupError, match="nothing there"):
        await within(1.0, fail())


async def test_a_cancellation_that_arrives_together_with_the_event_is_not_lost() -> None:
    event = asyncio.Event()

    async def wait_for_ever() -> None:
        while True:
            await within(1.0, event.wait())
            event.clear()

    task = asyncio.create_task(wait_for_ever())
    await asyncio.sleep(0.01)
    event.set()
    # One turn of the loop later the wait is done but not yet reported: here `asyncio.wait_for` loses the cancellation.
    for _ in range(2):
        await asyncio.sleep(0)
    task.cancel()
    done, _ = await asyncio.wait({task}, timeout=1.0)
    assert done
    assert task.cancelled()


async def test_unfinished_work_is_cancelled() -> None:
    cancelled = asyncio.Event()

    async def work() -> None:
        try:
            await asyncio.sleep(10.0)
        finally:
            cancelled.set()

    assert not await within(0.01, work())
    await asyncio.sleep(0)
    assert cancelled.is_set()


async def test_a_clock_that_is_set_ends_each_kind_of_wait() -> None:
    clock, event = SetClock(), asyncio.Event()
    never = asyncio.get_running_loop().create_future()
    waits = (
        sleep(2.0, clock),
        wait_set(event, 2.0, clock),
        done_within(2.0, never, clock),
        within(2.0, asyncio.Event().wait(), clock),
    )
    tasks = [asyncio.create_task(wait) for wait in waits]
    while len(clock.timers) < len(tasks):
        await asyncio.sleep(0)
    clock.go_to(START_NS + 2 * S - 1)
    for _ in range(3):
        await asyncio.sleep(0)
    assert not any(task.done() for task in tasks)
    clock.go_to(START_NS + 2 * S)
    assert await asyncio.gather(*tasks) == [None, None, False, False]
    assert event.is_set()
    assert not never.done()


async def test_what_ends_sooner_takes_its_call_back() -> None:
    clock, event, done = SetClock(), asyncio.Event(), asyncio.get_running_loop().create_future()
    event.set()
    done.set_result(None)
    await wait_set(event, 2.0, clock)
    assert await done_within(2.0, done, clock)
    assert await within(2.0, event.wait(), clock)
    cancelled = asyncio.create_task(sleep(2.0, clock))
    await clock.waited_for()
    cancelled.cancel()
    await asyncio.gather(cancelled, return_exceptions=True)
    assert clock.due_ns() is None
