# SPDX-License-Identifier: Apache-2.0
"""The power switch of the demo's units: a small HTTP endpoint that the master's viewer offers as buttons.

In a real cell the same buttons post to a switch that feeds the units (PoE).
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
from collections.abc import Awaitable, Callable
from types import TracebackType
from urllib.parse import unquote

from shared.waiting import within

logger = logging.getLogger(__name__)

HEAD_BYTES_MAX = 2**14
"""Limit of a request's head; the requests here have no body and few headers."""

REQUEST_S = 5.0
"""Timeout for a whole request."""

LABELS = {"cut": "Cut this unit's power", "give": "Give it power again"}
"""Label of the button for each action."""

REASONS = {200: "OK", 404: "Not Found", 409: "Conflict"}

Switch = Callable[[str, str], Awaitable[str | None]]
"""Called with `cut` or `give` and a unit's address. Returns the reason of a refusal, or None."""


class PowerSwitch:
    """Listens on loopback while its context is open. `actions` is the value of the master's `unit_actions`."""

    def __init__(self, switch: Switch) -> None:
        self._switch = switch
        # Any page in a browser can post to loopback. The secret in the path keeps it out.
        self._secret = secrets.token_urlsafe(12)
        self._server: asyncio.Server | None = None

    async def __aenter__(self) -> PowerSwitch:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0, limit=HEAD_BYTES_MAX)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._server is not None
        self._server.close()

    @property
    def actions(self) -> dict[str, str]:
        """Map the label of each button to the URL that it posts to."""
        assert self._server is not None
        port = self._server.sockets[0].getsockname()[1]
        return {label: f"http://127.0.0.1:{port}/{self._secret}/{verb}/{{ip}}" for verb, label in LABELS.items()}

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            if not await within(REQUEST_S, self._answer(reader, writer)):
                logger.debug("power: expected a whole request within %g s, got a part of one", REQUEST_S)
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, ConnectionError) as error:
            logger.debug("power: %s", error)
        finally:
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        status, why = await self._do(head.split(b"\r\n", 1)[0].decode("latin-1").split())
        body = json.dumps({"detail": why or "done"}).encode()
        writer.write(
            f"HTTP/1.1 {status} {REASONS[status]}\r\nContent-Type: application/json\r\n"
            f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode()
            + body
        )
        await writer.drain()

    async def _do(self, line: list[str]) -> tuple[int, str | None]:
        parts = line[1].split("/") if len(line) == 3 and line[0] == "POST" else []
        if len(parts) != 4 or not secrets.compare_digest(parts[1].encode(), self._secret.encode()):
            return 404, "expected POST to a path of this switch, got another request"
        if parts[2] not in LABELS:
            return 404, f"expected one of {', '.join(LABELS)}, got {parts[2]}"
        why = await self._switch(parts[2], unquote(parts[3]))
        return (409, why) if why else (200, None)
