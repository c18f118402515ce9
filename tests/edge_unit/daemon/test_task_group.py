# SPDX-License-Identifier: Apache-2.0
"""Work that no frame waits for."""

from __future__ import annotations

import asyncio

from edge_unit.daemon.task_group import Errands


async def test_what_is_not_done_when_the_unit_ends_is_cancelled() -> None:
    errands, done, cancelled = Errands(), asyncio.Event(), asyncio.Event()

    async def short() -> None:
        done.set()

    async def endless() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            cancelled.set()

    errands.start(short())
    errands.start(endless())
    await done.wait()
    assert not cancelled.is_set()
    await errands.end()
    assert cancelled.is_set()
