# SPDX-License-Identifier: Apache-2.0
"""Commands of the master, sorted by the time of their execution."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from dataclasses import dataclass, field

from shared.messages import Command


@dataclass(frozen=True)
class CommandBatch:
    """Commands that replace a frame, that run before it is filtered, or that need its result."""

    calibrations: list[Command] = field(default_factory=list)
    changes: list[Command] = field(default_factory=list)
    images: list[Command] = field(default_factory=list)

    @classmethod
    def take(cls, queue: asyncio.Queue[Command]) -> CommandBatch:
        """Take all waiting commands."""
        batch = cls()
        while not queue.empty():
            command = queue.get_nowait()
            batch._kind(command).append(command)
        return batch

    def _kind(self, command: Command) -> list[Command]:
        if command.verb == "calibrate":
            return self.calibrations
        return self.images if command.verb == "image" else self.changes


def put_back(queue: asyncio.Queue[Command], commands: Iterable[Command]) -> None:
    """Put `commands` back, for the next frame."""
    for command in commands:
        queue.put_nowait(command)
