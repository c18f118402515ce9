# SPDX-License-Identifier: Apache-2.0
"""HTTP/1.1 as a unit needs it: connections that stay open, each request in one write.

A unit asks its master twice for every frame. A general client takes ten times the processor for that (0.9 ms
against 0.07 ms on a desktop core), which on a small board is a tenth of a core for nothing.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol
from urllib.parse import urlsplit

from shared.errors import ConfigError, MasterUnreachable, WireError

CONNECT_TIMEOUT_S = 1.0
"""On one's own network; the first packet is repeated after a second."""

MAX_HEAD_BYTES = 16 * 1024
"""Of status and headers; our master sends a hundred."""

MAX_IDLE = 4
"""Connections kept open: updates, joints, and what an operator changes."""

DEFAULT_PORTS = {"http": 80, "https": 443}


@dataclass(frozen=True)
class Answer:
    """A status and all of its body."""

    status: int
    body: bytes


class Http(Protocol):
    """What carries requests to the master and answers back."""

    async def request(
        self, method: str, path: str, headers: Mapping[str, str], body: bytes, timeout_s: float, max_bytes: int
    ) -> Answer:
        """Send one request, and return what came of it, whatever its status.

        Raises:
            MasterUnreachable: nobody answered in time.
            WireError: the answer is no HTTP, or its body is longer than `max_bytes`.
        """
        ...

    async def close(self) -> None:
        """Close all connections."""
        ...


class HttpConnections:
    """Connections to one server, opened when they are needed; requests may run beside each other."""

    def __init__(self, url: str, source_address: str | None = None) -> None:
        """`source_address` is an own IP to connect from. Raises ConfigError when `url` has no host."""
        parts = urlsplit(url)
        if parts.scheme not in DEFAULT_PORTS or not parts.hostname:
            raise ConfigError(f"master_url: expected http://host:port, got {url}")
        self._url = url
        self._host = parts.hostname
        self._netloc = parts.netloc
        self._port = parts.port or DEFAULT_PORTS[parts.scheme]
        self._tls = ssl.create_default_context() if parts.scheme == "https" else None
        self._local_address = None if source_address is None else (source_address, 0)
        self._idle: list[_Connection] = []

    async def request(
        self, method: str, path: str, headers: Mapping[str, str], body: bytes, timeout_s: float, max_bytes: int
    ) -> Answer:
        """See `Http`."""
        fields = {"Host": self._netloc, **headers}
        if body:
            fields["Content-Length"] = str(len(body))
        lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in fields.items()), "", ""]
        message = "\r\n".join(lines).encode("latin-1") + body
        connection = await self._connection()
        timer = asyncio.get_running_loop().call_later(timeout_s, connection.expire)
        try:
            answer = await connection.exchange(message, max_bytes)
        except WireError as error:
            connection.abort()
            raise WireError(f"{self._url}{path}: {error}") from error
        except (OSError, EOFError) as error:
            connection.abort()
            what = f"no answer within {timeout_s:g} s" if connection.expired else str(error) or "connection lost"
            raise MasterUnreachable(f"{self._url}{path}: {what}") from error
        except BaseException:
            # Cancelled: the answer that is still to come must not be taken for that to the next request.
            connection.abort()
            raise
        finally:
            timer.cancel()
        if connection.reusable and len(self._idle) < MAX_IDLE:
            self._idle.append(connection)
        else:
            connection.abort()
        return answer

    async def close(self) -> None:
        """See `Http`."""
        while self._idle:
            await self._idle.pop().close()

    async def _connection(self) -> _Connection:
        """One that is open and idle, or a new one."""
        while self._idle:
            connection = self._idle.pop()
            if connection.reusable:
                return connection
            connection.abort()
        opening = asyncio.ensure_future(
            asyncio.open_connection(
                self._host, self._port, ssl=self._tls, local_addr=self._local_address, limit=MAX_HEAD_BYTES
            )
        )
        try:
            # Not wait_for, which until Python 3.12 swallows a cancellation that comes together with the result.
            await asyncio.wait({opening}, timeout=CONNECT_TIMEOUT_S)
            if not opening.done():
                raise MasterUnreachable(f"{self._url}: no connection within {CONNECT_TIMEOUT_S:g} s")
            return _Connection(*opening.result())
        except OSError as error:
            raise MasterUnreachable(f"{self._url}: {error.strerror or error}") from error
        except asyncio.CancelledError:
            if opening.done() and not opening.cancelled() and opening.exception() is None:
                opening.result()[1].transport.abort()
            raise
        finally:
            opening.cancel()


class _Connection:
    """One connection, one request at a time."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._keep = True
        self.expired = False

    @property
    def reusable(self) -> bool:
        """Whether another request may be sent; the server may have hung up meanwhile."""
        return self._keep and not self._reader.at_eof() and not self._writer.is_closing()

    def expire(self) -> None:
        """The time for an answer is over."""
        self.expired = True
        self.abort()

    def abort(self) -> None:
        """Hang up at once."""
        self._keep = False
        self._writer.transport.abort()

    async def close(self) -> None:
        """Hang up in good order."""
        self._writer.close()
        with suppress(OSError):
            await self._writer.wait_closed()

    async def exchange(self, message: bytes, max_bytes: int) -> Answer:
        """Send a request and read its answer.

        Raises:
            OSError, EOFError: the connection broke.
            WireError: the answer is no HTTP, or too long.
        """
        self._writer.write(message)
        await self._writer.drain()
        try:
            status, fields = _head(await self._reader.readuntil(b"\r\n\r\n"))
            while 100 <= status < 200:
                status, fields = _head(await self._reader.readuntil(b"\r\n\r\n"))
            self._keep = fields.get(b"connection", b"").lower() != b"close"
            return Answer(status, await self._body(status, fields, max_bytes))
        except asyncio.LimitOverrunError as error:
            raise WireError(f"expected a head of at most {MAX_HEAD_BYTES} bytes") from error

    async def _body(self, status: int, fields: dict[bytes, bytes], max_bytes: int) -> bytes:
        if status in (204, 304):
            return b""
        if fields.get(b"transfer-encoding", b"").lower() == b"chunked":
            return await self._chunks(max_bytes)
        length = fields.get(b"content-length")
        if length is None:
            # The server tells the end by hanging up.
            self._keep = False
            body = await self._reader.read(max_bytes + 1)
            while len(body) <= max_bytes and not self._reader.at_eof():
                body += await self._reader.read(max_bytes + 1 - len(body))
            _check_length(len(body), max_bytes)
            return body
        count = _number(length, 10, "content-length")
        _check_length(count, max_bytes)
        return await self._reader.readexactly(count)

    async def _chunks(self, max_bytes: int) -> bytes:
        body = bytearray()
        while count := _number((await self._reader.readuntil(b"\r\n")).split(b";")[0].strip(), 16, "chunk"):
            _check_length(len(body) + count, max_bytes)
            body += (await self._reader.readexactly(count + 2))[:-2]
        while (await self._reader.readuntil(b"\r\n")).strip():
            # Trailing fields say nothing to us.
            continue
        return bytes(body)


def _head(data: bytes) -> tuple[int, dict[bytes, bytes]]:
    """Status and header fields, names in lower case."""
    first, *lines = data[:-4].split(b"\r\n")
    words = first.split(b" ", 2)
    if len(words) < 2 or not words[0].startswith(b"HTTP/1."):
        raise WireError(f"expected an HTTP answer, got {first[:40]!r}")
    fields = {}
    for line in lines:
        name, _, value = line.partition(b":")
        fields[name.strip().lower()] = value.strip()
    if words[0] == b"HTTP/1.0":
        fields.setdefault(b"connection", b"close")
    return _number(words[1], 10, "status"), fields


def _number(text: bytes, base: int, what: str) -> int:
    """Plain digits only: `int` alone would also take signs, spaces and underscores."""
    digits = b"0123456789abcdefABCDEF"[: 10 if base == 10 else 22]
    if not text or len(text) > 16 or text.strip(digits):
        raise WireError(f"{what}: expected a number, got {text[:20]!r}")
    return int(text, base)


def _check_length(count: int, max_bytes: int) -> None:
    if count > max_bytes:
        raise WireError(f"expected at most {max_bytes} bytes, got more")
