# SPDX-License-Identifier: Apache-2.0
"""The master's commands: waiting, being executed, and finished with an outcome.

Only `finish` may be called from the thread that processes frames. All other methods belong to the event loop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from queue import Empty, SimpleQueue

from shared.messages import DONE, MAX_COMMANDS, Command, Ended, Outcome


class CommandLedger:
    """The commands of one session.

    Attributes:
        waiting: the commands that are not taken yet.
    """

    def __init__(self) -> None:
        self.waiting: asyncio.Queue[Command] = asyncio.Queue(MAX_COMMANDS)
        self._open: dict[int, Command] = {}
        self._finished: SimpleQueue[Ended] = SimpleQueue()
        self._ended: list[Ended] = []

    def accept(self, commands: Iterable[Command]) -> None:
        """Queue the new ones of `commands`. The master sends a command again if the queue was full."""
        for command in commands:
            if command.id not in self._open and not self.waiting.full():
                self._open[command.id] = command
                self.waiting.put_nowait(command)

    def finish(self, command: Command, outcome: Outcome = DONE) -> None:
        """Report the outcome of `command` with the next update. May be called from any thread."""
        self._finished.put(Ended.of(command.id, outcome))

    def ended(self) -> tuple[Ended, ...]:
        """Return the outcomes that the next update reports, at most `MAX_COMMANDS`."""
        while True:
            try:
                ended = self._finished.get_nowait()
            except Empty:
                return tuple(self._ended[:MAX_COMMANDS])
            if ended.id in self._open:
                self._ended.append(ended)

    def forget(self, received: Iterable[Ended]) -> None:
        """Forget the outcomes that the master has received."""
        for ended in received:
            self._ended.remove(ended)
            self._open.pop(ended.id, None)

    def clear(self) -> None:
        """Forget the commands of the session. The master sends unfinished commands again."""
        self._open.clear()
        self.ended()
        self._ended.clear()
        while not self.waiting.empty():
            self.waiting.get_nowait()
