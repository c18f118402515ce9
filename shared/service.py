# SPDX-License-Identifier: Apache-2.0
"""sd_notify messages to the service manager that started this process: ready, alive, status, stopping.

Without a service manager, no message is sent and nothing else changes. These few lines are our own: the package for
it is a source distribution only, and units install nothing that must be built.
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
"""Maximum length of a status in characters: a person reads it as one line."""

STATUS_PERIOD_S = 2.0
"""Period of the status when no watchdog requires a shorter one; a person reads a status at most this old."""

FEEDS_PER_LIMIT = 4
"""Watchdog messages per watchdog limit. A few delayed turns of the event loop on a busy board do not trip it."""


class ServiceManager:
    """The service manager of this process, if there is one."""

    def __init__(self, environment: Mapping[str, str] | None = None, pid: int | None = None) -> None:
        environment = os.environ if environment is None else environment
        address = environment.get(SOCKET_VARIABLE, "")
        # A leading @ stands for the zero byte of an abstract address.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog_s = _watchdog_s(environment, os.getpid() if pid is None else pid) if address else None
        """Watchdog limit in seconds: a message is due within this time. None: there is no watchdog."""

    @property
    def is_present(self) -> bool:
        """True if a service manager started this process."""
        return bool(self._address)

    def ready(self, status: str) -> None:
        """Report that the service is ready, so that dependent services may start."""
        self._send(f"READY=1\nSTATUS={_line(status)}")

    def alive(self, status: str) -> None:
        """Feed the watchdog and report the status."""
        self._send(f"WATCHDOG=1\nSTATUS={_line(status)}")

    def trigger_watchdog(self, status: str) -> None:
        """Trigger the watchdog now; to wait for its limit would only cost time."""
        self._send(f"STATUS={_line(status)}\nWATCHDOG=trigger")

    def stopping(self) -> None:
        """Report an orderly stop."""
        self._send("STOPPING=1\nSTATUS=stopping")

    async def follow(self, status: Callable[[], str], stuck: Callable[[], str | None] = lambda: None) -> None:
        """Feed the watchdog from this event loop until cancelled, while `stuck` returns None.

        `stuck` returns a sentence about a part that hangs. Trigger the watchdog only when two checks in a row report
        one: after the first, the board itself may have been suspended.
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
                self.trigger_watchdog(hanging)
            hung = hanging is not None
            await asyncio.sleep(period_s)

    def _send(self, message: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as datagram:
                # A busy manager must not block the event loop; the next period sends the status again.
                datagram.setblocking(False)
                datagram.sendto(message.encode(), self._address)
        except OSError as error:
            logger.debug("no message to the service manager: %s", error)


def _watchdog_s(environment: Mapping[str, str], pid: int) -> float | None:
    """Parse the watchdog limit as sd_watchdog_enabled(3): addressed to this process, and a number above zero."""
    limit_us, addressed_to = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not limit_us.isdecimal() or int(limit_us) == 0 or addressed_to not in ("", str(pid)):
        return None
    return int(limit_us) / 1e6


def _line(text: str) -> str:
    """Return `text` without line breaks, since a line break starts another assignment."""
    return " ".join(text.split())[:MAX_STATUS]
