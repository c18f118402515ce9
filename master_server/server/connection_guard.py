# SPDX-License-Identifier: Apache-2.0
"""Sockets held within bounds: how many, for how long without a whole request, with how long a head, and TLS.

The server below bounds none of these by itself. Connections are counted before the first byte of TLS is read, since
a handshake costs more than most requests.
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
"""From a connection, or the first byte of a request, to the end of its headers; also for a TLS handshake."""

MESSAGE_S = 65.0
"""For a whole request, whatever reads it; the largest, a cell as a zip, is given 60 s, and most much less."""

MAX_HEAD_BYTES = 2**14
"""Of a request's line and headers; ours take a hundredth of it, a browser's a tenth."""

ACCEPT_AGAIN_S = 0.1
"""Before the next attempt when the system gave none."""

RESET = struct.pack("ii", 1, 0)
"""For SO_LINGER: closing sends a reset."""

NOISE = ("Invalid HTTP request received.", "Unsupported upgrade request.")
"""What strangers can have written into the log as often as they like."""


def server_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """TLS 1.2 or later with this certificate (PEM, with what chain it needs) and its key.

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
        # An empty password, or a person would be asked for one.
        context.load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, ValueError) as error:
        reason = getattr(error, "reason", None) or str(error)
        raise ConfigError(
            f"tls_certificate {certificate}, tls_key {key}: expected a certificate and its key in PEM, "
            f"without a password: {reason}"
        ) from error
    return context


def fingerprint(certificate: Path) -> str:
    """The sha256 of the first certificate in a PEM file, as units may be told it."""
    text = certificate.read_text(encoding="ascii", errors="replace")
    begin, end = text.index(ssl.PEM_HEADER), text.index(ssl.PEM_FOOTER)
    der = ssl.PEM_cert_to_DER_cert(text[begin : end + len(ssl.PEM_FOOTER)])
    return hashlib.sha256(der).hexdigest()


class Acceptor:
    """Takes connections in, for as long as it is not closed."""

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
        """Begin; needs a running event loop."""
        self._listener.setblocking(False)
        self._begin(self._accept())

    def close(self) -> None:
        """Take none in any more, and give up on those that are still shaking hands."""
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
                # The caller is gone already, or the process has no file left.
                logger.warning("cannot take a connection in: %s", error)
                await asyncio.sleep(ACCEPT_AGAIN_S)
                continue
            ip, now_ns = plain_ip(str(address[0])), monotonic_ns()
            if self._limits.connect(ip, now_ns):
                self._begin(self._shake_hands(connection, ip))
            else:
                if self._limits.may_be_logged(ip, now_ns):
                    text = "a connection of %s is turned away, %d are open"
                    logger.warning(text, ip, self._limits.connections, extra={"event": "connection", "ip": ip})
                # Reset, so that nothing of it is kept waiting on our side.
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
            # No TLS, too slow, or gone; ssl.SSLError is one of these.
            connection.close()
        finally:
            if not protocol.begun:
                self._limits.disconnect(ip)


class GuardedHttp(HttpToolsProtocol):
    """One connection, of which no more is taken than one of ours needs."""

    leave: Callable[[], None] | None = None
    begun = False
    _deadline: asyncio.TimerHandle | None = None
    _allowed_s: float | None = None
    _begins_anew = False
    _in_head = True
    _head_bytes = 0

    # The base narrows the type as well.
    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.begun = True
        super().connection_made(transport)
        self._give(HEAD_S)

    def connection_lost(self, exc: Exception | None) -> None:
        self._give(None)
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
            # Also for one who does not read why.
            self._give(HEAD_S)
        elif self._begins_anew:
            # Once for all that came: a request that came whole needs no timer.
            self._give(self._allowed_s)

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._in_head, self._head_bytes = True, 0
        self._allow(HEAD_S)

    def on_header(self, name: bytes, value: bytes) -> None:
        # What comes after a body is no header that anyone asks for.
        if self._in_head:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self._in_head = False
        self._allow(MESSAGE_S)
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        self._allow(None)
        super().on_message_complete()

    def handle_websocket_upgrade(self) -> None:
        self._allow(None)
        super().handle_websocket_upgrade()
        protocol = self.transport.get_protocol()
        if isinstance(protocol, ReaderSocket):
            protocol.leave, self.leave = self.leave, None

    def _allow(self, seconds: float | None) -> None:
        """For what comes next, from the end of what has come already."""
        self._allowed_s, self._begins_anew = seconds, True

    def _give(self, seconds: float | None) -> None:
        """Until the connection is closed, unless this is called again."""
        self._begins_anew = False
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self.loop.call_later(seconds, self.transport.abort)


def quiet(record: logging.LogRecord) -> bool:
    """A filter for the log of the server below."""
    return not str(record.msg).startswith(NOISE)
