# SPDX-License-Identifier: Apache-2.0
"""Background tasks, which no frame waits for."""

from __future__ import annotations

import asyncio

from edge_unit.daemon.task_group import TaskGroup


async def test_unfinished_tasks_are_cancelled_at_the_end() -> None:
    tasks, done, cancelled = TaskGroup(), asyncio.Event(), asyncio.Event()

    async def short() -> None:
        done.set()

    async def endless() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            cancelled.set()

    tasks.start(short())
    tasks.start(endless())
    await done.wait()
    assert not cancelled.is_set()
    await tasks.end()
    assert cancelled.is_set()
