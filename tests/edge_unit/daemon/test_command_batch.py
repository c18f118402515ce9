# SPDX-License-Identifier: Apache-2.0
"""The master's commands, sorted by the time of their execution."""

from __future__ import annotations

import asyncio

from edge_unit.daemon.command_batch import CommandBatch, put_back
from shared.messages import Command


async def test_each_command_has_its_time_and_none_is_lost() -> None:
    refine, image = Command(id=1, verb="refine"), Command(id=2, verb="image", image="depth")
    calibrate, drop = Command(id=3, verb="calibrate"), Command(id=4, verb="drop_background")
    queue: asyncio.Queue[Command] = asyncio.Queue()
    put_back(queue, (refine, image, calibrate, drop))
    batch = CommandBatch.take(queue)
    assert batch == CommandBatch([calibrate], [refine, drop], [image])
    assert queue.empty()
    put_back(queue, (*batch.changes, *batch.images))
    assert CommandBatch.take(queue) == CommandBatch([], [refine, drop], [image])
