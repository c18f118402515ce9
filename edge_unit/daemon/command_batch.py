# SPDX-License-Identifier: Apache-2.0
"""What the master asked for, by when it is carried out."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from dataclasses import dataclass, field

from shared.messages import Command


@dataclass(frozen=True)
class CommandBatch:
    """Commands: in place of a frame, before it is filtered, or afterwards with what it showed."""

    calibrations: list[Command] = field(default_factory=list)
    changes: list[Command] = field(default_factory=list)
    pictures: list[Command] = field(default_factory=list)

    @classmethod
    def take(cls, queue: asyncio.Queue[Command]) -> CommandBatch:
        """All that wait."""
        orders = cls()
        while not queue.empty():
            command = queue.get_nowait()
            orders._kind(command).append(command)
        return orders

    def _kind(self, command: Command) -> list[Command]:
        if command.verb == "calibrate":
            return self.calibrations
        return self.pictures if command.verb == "image" else self.changes


def put_back(queue: asyncio.Queue[Command], commands: Iterable[Command]) -> None:
    """Have `commands` wait for the next frame."""
    for command in commands:
        queue.put_nowait(command)
