# SPDX-License-Identifier: Apache-2.0
"""The web server's WebSocket for readers of the current state: it drops a message that cannot be sent at once.

Without this, the socket buffers megabytes for a reader that does not read, which are seconds of an outdated map.
"""

from __future__ import annotations

import socket
from asyncio.transports import BaseTransport
from collections.abc import Callable
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

UNSENT_MAX_BYTES = 2**14
"""Bytes not yet sent that the kernel may hold; beyond, the writer waits and sends the newest state afterwards."""

PING_S = 5.0
"""A reader that is gone or does not read is disconnected after at most two of these."""

CLOSE_S = 0.5
"""Time for a reader to receive the close message; without reading it is disconnected anyway."""

MESSAGE_MAX_BYTES = 2**12
"""Largest message from a reader; readers send next to nothing."""


class ReaderSocket(WebSocketsSansIOProtocol):
    """Keep at most one waiting message, and disconnect a reader that does not answer."""

    leave: Callable[[], None] | None = None
    """Called when the connection has ended."""

    def connection_made(self, transport: BaseTransport) -> None:
        super().connection_made(transport)
        # Not 0: under TLS an empty buffer would then count as full, and nothing would ever be sent.
        self.transport.set_write_buffer_limits(high=1, low=0)
        connection = transport.get_extra_info("socket")
        if connection is not None and hasattr(socket, "TCP_NOTSENT_LOWAT"):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_MAX_BYTES)

    def connection_lost(self, exc: Exception | None) -> None:
        if self.leave is not None:
            self.leave()
        super().connection_lost(exc)

    async def send(self, message: Any) -> None:
        if message["type"] == "websocket.close":
            self.loop.call_later(CLOSE_S, self.transport.abort)
        await super().send(message)

    def keepalive_timeout(self) -> None:
        super().keepalive_timeout()
        # A normal close would first wait until a reader that does not read has read everything.
        self.transport.abort()


SERVER_OPTIONS: dict[str, Any] = {
    "ws": ReaderSocket,
    "ws_ping_interval": PING_S,
    "ws_ping_timeout": PING_S,
    "ws_max_size": MESSAGE_MAX_BYTES,
    # It would be computed for each reader, at more than the cost of making the message.
    "ws_per_message_deflate": False,
}
"""For `uvicorn.Config`."""
