# SPDX-License-Identifier: Apache-2.0
"""The web server's WebSocket, for readers that must hear what is true now: what cannot be sent at once is not kept.

By itself a socket takes megabytes for a reader that does not read, which are seconds of a map that is long past.
"""

from __future__ import annotations

import socket
from asyncio.transports import BaseTransport
from collections.abc import Callable
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

UNSENT_MAX_BYTES = 2**14
"""What the kernel may hold that is not under way yet; then the writer waits, and takes the newest afterwards."""

PING_S = 5.0
"""A reader that is gone, or does not read, is let go after two of these at most."""

CLOSE_S = 0.5
"""For a reader to hear that it is let go; whoever does not read is let go without."""

MESSAGE_MAX_BYTES = 2**12
"""Readers have nothing to say but that they go."""


class ReaderSocket(WebSocketsSansIOProtocol):
    """Holds back at most one message, and lets go of who does not answer."""

    leave: Callable[[], None] | None = None
    """Told when the connection has ended."""

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
        # Closing would first wait for all to be read, by one who does not read.
        self.transport.abort()


SERVER_OPTIONS: dict[str, Any] = {
    "ws": ReaderSocket,
    "ws_ping_interval": PING_S,
    "ws_ping_timeout": PING_S,
    "ws_max_size": MESSAGE_MAX_BYTES,
    # It would be done anew for each reader, at more than the cost of making the message.
    "ws_per_message_deflate": False,
}
"""For `uvicorn.Config`."""
