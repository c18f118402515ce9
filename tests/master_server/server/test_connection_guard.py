# SPDX-License-Identifier: Apache-2.0
"""A server on a real socket, and peers that send slowly, too much, or no HTTP at all."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import suppress
from dataclasses import dataclass

import pytest
import uvicorn

from master_server.app import make_app
from master_server.security import Access, Limits
from master_server.security.rate_limits import CONNECTIONS_PER_ADDRESS
from master_server.server import connection_guard
from master_server.server.connection_guard import MAX_HEAD_BYTES, Acceptor, GuardedHttp
from shared.clock import NS_PER_S, monotonic_ns
from shared.waiting import within
from tests.master_server.fakes import master
from tests.master_server.test_app import OPERATOR, UNIT

pytestmark = pytest.mark.alone

HEAD_S, MESSAGE_S = 0.3, 0.9
SLACK_S = 1.0
"""Timeout on a busy machine."""
DRIP_S = 0.05
WAIT_S = 5.0

HEALTH = b"GET /healthz HTTP/1.1\r\nHost: m\r\n\r\n"
UPDATE = (
    b"POST /update HTTP/1.1\r\nHost: m\r\nAuthorization: Bearer " + UNIT.encode() + b"\r\nContent-Length: 1000\r\n\r\n"
)


@dataclass
class Place:
    """A master behind a socket of loopback; `timers` are the timeouts that its connections set."""

    port: int
    limits: Limits
    timers: list[float]

    async def connect(self, ip: str = "127.0.0.1") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection("127.0.0.1", self.port, local_addr=(ip, 0))


@pytest.fixture
async def place(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Place]:
    monkeypatch.setattr(connection_guard, "HEAD_S", HEAD_S)
    monkeypatch.setattr(connection_guard, "MESSAGE_S", MESSAGE_S)
    limits, timers = Limits(), list[float]()

    class Watched(GuardedHttp):
        def _set_timer(self, seconds: float | None) -> None:
            if seconds is not None:
                timers.append(seconds)
            super()._set_timer(seconds)

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            acceptor.start()

    app = make_app(master(), Access(UNIT.encode(), OPERATOR.encode()), None, limits)
    config = uvicorn.Config(app, http=Watched, log_config=None, access_log=False, timeout_graceful_shutdown=1)
    server = Server(config)
    with socket.create_server(("127.0.0.1", 0), backlog=256) as listener:
        acceptor = Acceptor(listener, limits, lambda: Watched(config, server.server_state, server.lifespan.state), None)
        task = asyncio.ensure_future(server.serve([]))
        try:
            yield Place(listener.getsockname()[1], limits, timers)
        finally:
            acceptor.close()
            server.should_exit = True
            await task


async def answer(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    """Return status and body of the next answer."""
    head = await reader.readuntil(b"\r\n\r\n")
    length = int(head.lower().split(b"content-length:")[1].split(b"\r\n")[0])
    return int(head.split(b" ", 2)[1]), await reader.readexactly(length)


async def seconds_until_closed(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, drip: bytes = b"") -> float:
    """Send a byte of `drip` from time to time until the other side closes; return the seconds."""
    began_ns = monotonic_ns()

    async def send() -> None:
        for number in range(len(drip)):
            writer.write(drip[number : number + 1])
            await asyncio.sleep(DRIP_S)

    sending = asyncio.ensure_future(send())

    async def until_closed() -> None:
        with suppress(ConnectionError):
            while await reader.read(1000):
                pass

    try:
        assert await within(WAIT_S, until_closed())
    finally:
        sending.cancel()
        writer.transport.abort()
    return (monotonic_ns() - began_ns) / NS_PER_S


@pytest.mark.parametrize("drip", [b"", HEALTH[:10] + b"a" * 500, b"GET / HTTP/1.1\r\n" + b"a:b\r\n" * 100])
async def test_a_slow_head_closes_the_connection(drip: bytes, place: Place) -> None:
    assert HEAD_S - 0.05 < await seconds_until_closed(*await place.connect(), drip) < HEAD_S + SLACK_S


async def test_the_next_head_on_a_connection_has_the_same_timeout(place: Place) -> None:
    reader, writer = await place.connect()
    writer.write(HEALTH)
    assert (await answer(reader))[0] == 200
    assert HEAD_S - 0.05 < await seconds_until_closed(reader, writer, HEALTH[:-2]) < HEAD_S + SLACK_S
    # Behind a whole request, in the same piece.
    reader, writer = await place.connect()
    writer.write(HEALTH + HEALTH[:10])
    assert (await answer(reader))[0] == 200
    assert await seconds_until_closed(reader, writer) < HEAD_S + SLACK_S


async def test_a_slow_body_closes_the_connection(place: Place) -> None:
    reader, writer = await place.connect()
    writer.write(UPDATE)
    taken_s = await seconds_until_closed(reader, writer, b"\0" * 1000)
    assert MESSAGE_S - 0.05 < taken_s < MESSAGE_S + SLACK_S


async def test_a_head_without_end_is_refused(place: Place) -> None:
    reader, writer = await place.connect()
    writer.write(b"GET / HTTP/1.1\r\na: " + b"a" * (2 * MAX_HEAD_BYTES))
    status, body = await answer(reader)
    assert (status, body) == (400, f"Expected a head of at most {MAX_HEAD_BYTES} bytes.".encode())
    assert await seconds_until_closed(reader, writer) < WAIT_S


@pytest.mark.parametrize("noise", [b"\0" * 100, b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", b"hello\r\n\r\n"])
async def test_invalid_http_is_refused_at_once(noise: bytes, place: Place) -> None:
    reader, writer = await place.connect()
    writer.write(noise)
    assert (await answer(reader))[0] == 400
    assert await seconds_until_closed(reader, writer) < WAIT_S


async def test_whole_requests_and_pauses_between_them_start_no_timer(place: Place) -> None:
    reader, writer = await place.connect()
    for _ in range(20):
        writer.write(HEALTH)
        assert (await answer(reader))[0] == 200
    assert place.timers == [HEAD_S]
    await asyncio.sleep(2 * HEAD_S)
    # In pieces that arrive in time.
    for piece in (HEALTH[:10], HEALTH[10:]):
        writer.write(piece)
        await asyncio.sleep(DRIP_S)
    assert (await answer(reader))[0] == 200
    assert place.timers == [HEAD_S, HEAD_S]
    await asyncio.sleep(2 * HEAD_S)
    writer.write(HEALTH)
    assert (await answer(reader))[0] == 200
    writer.close()


async def test_connections_of_an_address_are_bounded_and_released(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_guard, "HEAD_S", 2 * WAIT_S)
    held = [await place.connect("127.0.0.2") for _ in range(CONNECTIONS_PER_ADDRESS)]
    # The operating system accepts it before we do; then it is reset.
    assert await seconds_until_closed(*await place.connect("127.0.0.2")) < WAIT_S
    reader, writer = await place.connect("127.0.0.3")
    writer.write(HEALTH)
    assert (await answer(reader))[0] == 200
    writer.close()
    for _, writer in held:
        writer.transport.abort()

    async def until_none() -> None:
        while place.limits.connections:
            await asyncio.sleep(0.01)

    assert await within(WAIT_S, until_none())
