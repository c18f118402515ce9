# SPDX-License-Identifier: Apache-2.0
"""What the service manager that started this process is told (sd_notify): ready, alive, how it goes, stopping.

Without one, nobody is told and nothing else is different. Own few lines, since the package that does the same is a
source distribution only, and boards install nothing that has to be built.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import Callable, Mapping

logger = logging.getLogger(__name__)

SOCKET_VARIABLE = "NOTIFY_SOCKET"

MAX_STATUS = 500
"""Characters of a status: it is one line that a person reads."""

STATUS_PERIOD_S = 2.0
"""How old a status may be that a person reads, where no watchdog asks more often."""

FEEDS_PER_LIMIT = 4
"""A watchdog is fed so often within its limit that a few lost turns on a busy board do not trip it."""


class ServiceManager:
    """The service manager of this process, if there is one."""

    def __init__(self, environment: Mapping[str, str] | None = None, pid: int | None = None) -> None:
        environment = os.environ if environment is None else environment
        address = environment.get(SOCKET_VARIABLE, "")
        # A leading @ stands for the zero byte of an abstract address.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog_s = _watchdog_s(environment, os.getpid() if pid is None else pid) if address else None
        """Within so many seconds it wants to hear that we are alive; None: it does not watch."""

    @property
    def listens(self) -> bool:
        """Whether there is one."""
        return bool(self._address)

    def ready(self, status: str) -> None:
        """What depends on this service may start."""
        self._tell(f"READY=1\nSTATUS={_line(status)}")

    def alive(self, status: str) -> None:
        """Feed the watchdog, and tell how it goes."""
        self._tell(f"WATCHDOG=1\nSTATUS={_line(status)}")

    def hangs(self, status: str) -> None:
        """Have the watchdog strike now: waiting for its limit would only cost time."""
        self._tell(f"STATUS={_line(status)}\nWATCHDOG=trigger")

    def stopping(self) -> None:
        """It ends in good order."""
        self._tell("STOPPING=1\nSTATUS=stopping")

    async def follow(self, status: Callable[[], str], stuck: Callable[[], str | None] = lambda: None) -> None:
        """Feed the watchdog from this event loop until cancelled, for as long as `stuck` names nothing that hangs.

        Only what hangs at two looks in a row does: the board itself may have stood still.
        """
        limit_s = self.watchdog_s
        period_s = STATUS_PERIOD_S if limit_s is None else min(STATUS_PERIOD_S, limit_s / FEEDS_PER_LIMIT)
        hung = False
        while True:
            hanging = stuck()
            if hanging is None:
                self.alive(status())
            elif hung:
                logger.error("%s", hanging)
                self.hangs(hanging)
            hung = hanging is not None
            await asyncio.sleep(period_s)

    def _tell(self, message: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as datagram:
                # A manager that is busy must not hold up the loop; what it misses is said again.
                datagram.setblocking(False)
                datagram.sendto(message.encode(), self._address)
        except OSError as error:
            logger.debug("the service manager cannot be told: %s", error)


def _watchdog_s(environment: Mapping[str, str], pid: int) -> float | None:
    """As sd_watchdog_enabled(3): meant for this process, and a number above zero."""
    limit_us, meant_for = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not limit_us.isdecimal() or int(limit_us) == 0 or meant_for not in ("", str(pid)):
        return None
    return int(limit_us) / 1e6


def _line(text: str) -> str:
    """Without line breaks, which would begin another assignment."""
    return " ".join(text.split())[:MAX_STATUS]
