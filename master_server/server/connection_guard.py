# SPDX-License-Identifier: Apache-2.0
"""Bound the connections: their number, the time for a whole request, the size of its head. Serves TLS.

Uvicorn bounds none of these by itself. Connections are counted before the first byte of TLS is read, since a handshake
costs more than most requests.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import socket
import ssl
import struct
from collections.abc import Callable, Coroutine
from pathlib import Path

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from master_server.security import Limits, plain_ip
from master_server.server.latest_only_websocket import ReaderSocket
from shared.clock import monotonic_ns
from shared.errors import ConfigError

logger = logging.getLogger(__name__)

HEAD_S = 5.0
"""Time from a connection, or the first byte of a request, to the end of its headers; also for a TLS handshake."""

MESSAGE_S = 65.0
"""Time for any whole request; the largest, a cell as a zip, has 60 s, and most have much less."""

MAX_HEAD_BYTES = 2**14
"""Largest request line with headers; our clients need a hundredth of it, a browser a tenth."""

ACCEPT_AGAIN_S = 0.1
"""Delay before the next attempt when the system could give no connection."""

RESET = struct.pack("ii", 1, 0)
"""For SO_LINGER: closing sends a reset."""

NOISE = ("Invalid HTTP request received.", "Unsupported upgrade request.")
"""Lines that a stranger could write to the log without limit."""


def server_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return TLS 1.2 or later with this certificate (PEM, with its chain if needed) and its key.

    Raises:
        ConfigError: a file cannot be read, is no PEM, is encrypted, or the two do not belong together.
    """
    for name, path in (("tls_certificate", certificate), ("tls_key", key)):
        try:
            path.open("rb").close()
        except OSError as error:
            raise ConfigError(f"{name} {path}: cannot be read: {error.strerror}") from error
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        # An empty password, since the library would otherwise prompt for one.
        context.load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, ValueError) as error:
        reason = getattr(error, "reason", None) or str(error)
        raise ConfigError(
            f"tls_certificate {certificate}, tls_key {key}: expected a certificate and its key in PEM, "
            f"without a password: {reason}"
        ) from error
    return context


def fingerprint(certificate: Path) -> str:
    """Return the sha256 of the first certificate in a PEM file, in the form of a unit's configuration."""
    text = certificate.read_text(encoding="ascii", errors="replace")
    begin, end = text.index(ssl.PEM_HEADER), text.index(ssl.PEM_FOOTER)
    der = ssl.PEM_cert_to_DER_cert(text[begin : end + len(ssl.PEM_FOOTER)])
    return hashlib.sha256(der).hexdigest()


class Acceptor:
    """Accept connections until it is closed."""

    def __init__(
        self,
        listener: socket.socket,
        limits: Limits,
        make_protocol: Callable[[], GuardedHttp],
        tls: ssl.SSLContext | None,
    ) -> None:
        self._listener = listener
        self._limits = limits
        self._make_protocol = make_protocol
        self._tls = tls
        self._tasks: set[asyncio.Task[None]] = set()

    def start(self) -> None:
        """Start; needs a running event loop."""
        self._listener.setblocking(False)
        self._begin(self._accept())

    def close(self) -> None:
        """Stop accepting, and cancel unfinished TLS handshakes."""
        for task in self._tasks:
            task.cancel()

    def _begin(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, address = await loop.sock_accept(self._listener)
            except OSError as error:
                # The caller is gone already, or the process has no file descriptor left.
                logger.warning("cannot accept a connection: %s", error)
                await asyncio.sleep(ACCEPT_AGAIN_S)
                continue
            ip, now_ns = plain_ip(str(address[0])), monotonic_ns()
            if self._limits.connect(ip, now_ns):
                self._begin(self._shake_hands(connection, ip))
            else:
                if self._limits.may_be_logged(ip, now_ns):
                    text = "a connection of %s is refused, %d are open"
                    logger.warning(text, ip, self._limits.connections, extra={"event": "connection", "ip": ip})
                # Reset the connection, so that none of its data stays queued on our side.
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
                connection.close()

    async def _shake_hands(self, connection: socket.socket, ip: str) -> None:
        protocol = self._make_protocol()
        protocol.leave = lambda: self._limits.disconnect(ip)
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: protocol,
                connection,
                ssl=self._tls,
                ssl_handshake_timeout=None if self._tls is None else HEAD_S,
            )
        except OSError:
            # The caller speaks no TLS, is too slow, or is gone; ssl.SSLError is an OSError.
            connection.close()
        finally:
            if not protocol.started:
                self._limits.disconnect(ip)


class GuardedHttp(HttpToolsProtocol):
    """One connection, bounded to the needs of our clients."""

    leave: Callable[[], None] | None = None
    started = False
    _deadline: asyncio.TimerHandle | None = None
    _allowed_s: float | None = None
    _begins_anew = False
    _in_head = True
    _head_bytes = 0

    # The base narrows the type as well.
    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.started = True
        super().connection_made(transport)
        self._set_timer(HEAD_S)

    def connection_lost(self, exc: Exception | None) -> None:
        self._set_timer(None)
        if self.leave is not None:
            self.leave()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self.transport.is_closing():
            return
        super().data_received(data)
        if self._in_head:
            self._head_bytes += len(data)
            if self._head_bytes > MAX_HEAD_BYTES:
                self.send_400_response(f"Expected a head of at most {MAX_HEAD_BYTES} bytes.")
        if self.transport.is_closing():
            # Also closes the connection of a client that does not read the answer.
            self._set_timer(HEAD_S)
        elif self._begins_anew:
            # Once for all data that came: a request that came whole needs no timer.
            self._set_timer(self._allowed_s)

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._in_head, self._head_bytes = True, 0
        self._set_timer_from_end(HEAD_S)

    def on_header(self, name: bytes, value: bytes) -> None:
        # Ignore trailers after a body: nothing uses them.
        if self._in_head:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self._in_head = False
        self._set_timer_from_end(MESSAGE_S)
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        self._set_timer_from_end(None)
        super().on_message_complete()

    def handle_websocket_upgrade(self) -> None:
        self._set_timer_from_end(None)
        super().handle_websocket_upgrade()
        protocol = self.transport.get_protocol()
        if isinstance(protocol, ReaderSocket):
            protocol.leave, self.leave = self.leave, None

    def _set_timer_from_end(self, seconds: float | None) -> None:
        """Limit the time of the next part, counted from the end of the data that came already."""
        self._allowed_s, self._begins_anew = seconds, True

    def _set_timer(self, seconds: float | None) -> None:
        """Close the connection after `seconds`, unless this is called again."""
        self._begins_anew = False
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self.loop.call_later(seconds, self.transport.abort)


def quiet(record: logging.LogRecord) -> bool:
    """Filter such lines from the log of the web server."""
    return not str(record.msg).startswith(NOISE)
