# SPDX-License-Identifier: Apache-2.0
"""The master's commands: those that wait, those that are being carried out, and the outcomes of the others.

`finish` is the only way by which the worker thread passes anything to the event loop; everything else here belongs to
the loop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from queue import Empty, SimpleQueue

from shared.messages import DONE, MAX_COMMANDS, Command, Ended, Outcome


class CommandLedger:
    """The commands of one session.

    Attributes:
        waiting: commands that were not taken yet.
    """

    def __init__(self) -> None:
        self.waiting: asyncio.Queue[Command] = asyncio.Queue(MAX_COMMANDS)
        self._open: dict[int, Command] = {}
        self._finished: SimpleQueue[Ended] = SimpleQueue()
        self._ended: list[Ended] = []

    def accept(self, commands: Iterable[Command]) -> None:
        """Add new commands; the master sends those again that find no room."""
        for command in commands:
            if command.id not in self._open and not self.waiting.full():
                self._open[command.id] = command
                self.waiting.put_nowait(command)

    def finish(self, command: Command, outcome: Outcome = DONE) -> None:
        """Report the outcome of a command with the next update; may be called from any thread."""
        self._finished.put(Ended.of(command.id, outcome))

    def ended(self) -> tuple[Ended, ...]:
        """Return the outcomes for the next update, at most MAX_COMMANDS."""
        while True:
            try:
                ended = self._finished.get_nowait()
            except Empty:
                return tuple(self._ended[:MAX_COMMANDS])
            if ended.id in self._open:
                self._ended.append(ended)

    def forget(self, received: Iterable[Ended]) -> None:
        """Remove the outcomes that the master has received."""
        for ended in received:
            self._ended.remove(ended)
            self._open.pop(ended.id, None)

    def clear(self) -> None:
        """Remove the session's commands; the master sends those again that it still needs."""
        self._open.clear()
        self.ended()
        self._ended.clear()
        while not self.waiting.empty():
            self.waiting.get_nowait()
