# SPDX-License-Identifier: Apache-2.0
"""Against a server that says, byte for byte, what a test wants."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from collections.abc import AsyncIterator, Sequence

import pytest

from edge_unit import http as module
from edge_unit.http import MAX_HEAD_BYTES, Answer, HttpConnections
from shared.errors import ConfigError, MasterUnreachable, WireError

CHUNKED = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
CLOSED = b"HTTP/1.1 200 OK\r\nConnection: close\r\ncontent-length: 2\r\n\r\nok"
OLD = b"HTTP/1.0 200 OK\r\ncontent-length: 2\r\n\r\nok"
OK = b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\nok"


class Server:
    """Says one thing after each request; b"" hangs up, None says nothing."""

    def __init__(self, says: Sequence[bytes | None]) -> None:
        self._says = iter(says)
        self.connections = 0
        self.requests: list[bytes] = []
        self.peers: list[str] = []
        self._open: set[asyncio.StreamWriter] = set()
        self.said_all = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self.peers.append(writer.get_extra_info("peername")[0])
        self._open.add(writer)
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                length = [line for line in head.split(b"\r\n") if line.startswith(b"Content-Length:")]
                body = await reader.readexactly(int(length[0].split(b":")[1])) if length else b""
                self.requests.append(head + body)
                said = next(self._says)
                if said is None:
                    continue
                writer.write(said)
                if said == b"" or said.endswith(b"HANG UP"):
                    break
        writer.close()

    def hang_up(self) -> None:
        for writer in self._open:
            writer.transport.abort()


@contextlib.asynccontextmanager
async def serving(*says: bytes | None) -> AsyncIterator[tuple[Server, HttpConnections]]:
    server = Server(says)
    listening = await asyncio.start_server(server.serve, "127.0.0.1", 0)
    port = listening.sockets[0].getsockname()[1]
    http = HttpConnections(f"http://127.0.0.1:{port}", "127.0.0.44")
    try:
        yield server, http
    finally:
        await http.close()
        server.hang_up()
        listening.close()
        await listening.wait_closed()


async def get(http: HttpConnections, timeout_s: float = 5.0, max_bytes: int = 1000) -> Answer:
    return await http.request("GET", "/x", {"Accept": "a"}, b"", timeout_s, max_bytes)


async def test_a_request_is_what_it_should_be_and_comes_from_the_address() -> None:
    async with serving(OK, OK) as (server, http):
        assert await http.request("POST", "/x?y=1", {"A": "b"}, b"body", 5.0, 1000) == Answer(200, b"ok")
        await get(http)
    first, second = server.requests
    host = first.split(b"Host: ")[1].split(b"\r\n")[0]
    assert first == b"POST /x?y=1 HTTP/1.1\r\nHost: %s\r\nA: b\r\nContent-Length: 4\r\n\r\nbody" % host
    assert second == b"GET /x HTTP/1.1\r\nHost: %s\r\nAccept: a\r\n\r\n" % host
    assert set(server.peers) == {"127.0.0.44"}


async def test_a_connection_is_used_again() -> None:
    async with serving(*[OK] * 20) as (server, http):
        for _ in range(20):
            await get(http)
        assert server.connections == 1


async def test_requests_beside_each_other_have_connections_of_their_own() -> None:
    async with serving(*[OK] * 9) as (server, http):
        answers = await asyncio.gather(*(get(http) for _ in range(3)))
        assert answers == [Answer(200, b"ok")] * 3
        assert server.connections == 3
        await asyncio.gather(*(get(http) for _ in range(3)))
        assert server.connections == 3


async def test_a_server_that_hung_up_meanwhile_is_called_again() -> None:
    async with serving(OK, OK) as (server, http):
        await get(http)
        server.hang_up()
        await asyncio.sleep(0.02)
        assert await get(http) == Answer(200, b"ok")
        assert server.connections == 2


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (b"HTTP/1.1 204 No Content\r\n\r\n", Answer(204, b"")),
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", Answer(404, b"")),
        (b"HTTP/1.1 200\r\nCONTENT-LENGTH:2\r\n\r\nok", Answer(200, b"ok")),
        (b"HTTP/1.1 100 Continue\r\n\r\n" + OK, Answer(200, b"ok")),
        (CHUNKED + b"3\r\nabc\r\n1;x=y\r\nd\r\n0\r\n\r\n", Answer(200, b"abcd")),
        (CHUNKED + b"0\r\nTrailer: x\r\n\r\n", Answer(200, b"")),
        (b"HTTP/1.1 200 OK\r\n\r\nuntil HANG UP", Answer(200, b"until HANG UP")),
    ],
)
async def test_answers_of_every_form(said: bytes, expected: Answer) -> None:
    async with serving(said, OK) as (_, http):
        assert await get(http) == expected
        assert await get(http) == Answer(200, b"ok")


@pytest.mark.parametrize("said", [CLOSED, OLD])
async def test_a_server_that_wants_to_close_is_let(said: bytes) -> None:
    async with serving(said, OK) as (server, http):
        assert await get(http) == Answer(200, b"ok")
        await get(http)
        assert server.connections == 2


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (b"SSH-2.0-OpenSSH\r\n\r\n", "expected an HTTP answer"),
        (b"HTTP/1.1\r\n\r\n", "expected an HTTP answer"),
        (b"HTTP/1.1 2_0 OK\r\n\r\n", "status: expected a number"),
        (b"HTTP/1.1 200 OK\r\ncontent-length: -2\r\n\r\n", "content-length: expected a number"),
        (b"HTTP/1.1 200 OK\r\ncontent-length: 1001\r\n\r\n", "at most 1000 bytes"),
        (b"HTTP/1.1 200 OK\r\ncontent-length: 99999999999999999\r\n\r\n", "expected a number"),
        (CHUNKED + b"xyz\r\n", "chunk: expected a number"),
        (CHUNKED + b"3e9\r\n", "at most 1000 bytes"),
        (b"HTTP/1.1 200 OK\r\n\r\n" + b"x" * 2000 + b"HANG UP", "at most 1000 bytes"),
        (b"HTTP/1.1 200 OK\r\nx: " + b"x" * 2 * MAX_HEAD_BYTES + b"\r\n\r\n", "head of at most"),
    ],
)
async def test_what_is_no_answer_is_refused_and_the_connection_dropped(said: bytes, words: str) -> None:
    async with serving(said, OK) as (server, http):
        with pytest.raises(WireError, match=words):
            await get(http)
        assert await get(http) == Answer(200, b"ok")
        assert server.connections == 2


@pytest.mark.parametrize("said", [b"", b"HTTP/1.1 200 OK\r\ncontent-length: 9\r\n\r\nHANG UP", b"HTTP/1.1 2HANG UP"])
async def test_a_connection_that_breaks_is_unreachable(said: bytes) -> None:
    async with serving(said, OK) as (_, http):
        with pytest.raises(MasterUnreachable, match="/x: "):
            await get(http)
        assert await get(http) == Answer(200, b"ok")


@pytest.mark.parametrize("said", [None, b"HTTP/1.1 200 OK\r\ncontent-length: 9\r\n\r\nhalf"])
async def test_a_server_that_says_nothing_is_unreachable(said: bytes | None) -> None:
    async with serving(said, OK) as (_, http):
        with pytest.raises(MasterUnreachable, match=r"no answer within 0\.05 s"):
            await get(http, timeout_s=0.05)
        assert await get(http) == Answer(200, b"ok")


async def test_an_answer_that_nobody_waits_for_is_not_taken_for_another() -> None:
    async with serving(None, OK) as (server, http):
        waiting = asyncio.create_task(get(http))
        while not server.requests:
            await asyncio.sleep(0.001)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        assert await get(http) == Answer(200, b"ok")
        assert server.connections == 2


async def test_nobody_at_the_address() -> None:
    async with serving() as (_, http):
        pass
    with pytest.raises(MasterUnreachable, match="http://127"):
        await get(http)


async def test_an_address_of_ours_that_is_none() -> None:
    http = HttpConnections("http://127.0.0.1:9", "203.0.113.1")
    with pytest.raises(MasterUnreachable):
        await get(http)


@pytest.mark.parametrize("cancelled", [True, False])
async def test_a_connection_that_is_never_made(monkeypatch: pytest.MonkeyPatch, cancelled: bool) -> None:
    started = asyncio.Event()

    async def never(*arguments: object, **more: object) -> None:
        started.set()
        await asyncio.Event().wait()

    monkeypatch.setattr(module.asyncio, "open_connection", never)
    monkeypatch.setattr(module, "CONNECT_TIMEOUT_S", 0.05)
    waiting = asyncio.create_task(get(HttpConnections("http://127.0.0.1:9")))
    await started.wait()
    if cancelled:
        waiting.cancel()
    with pytest.raises(asyncio.CancelledError if cancelled else MasterUnreachable):
        await waiting


@pytest.mark.parametrize("url", ["http://", "ftp://host", "host:80", "http:///x"])
def test_a_master_without_a_host_is_refused(url: str) -> None:
    with pytest.raises(ConfigError, match="master_url"):
        HttpConnections(url)


def test_https_is_checked() -> None:
    http = HttpConnections("https://master")
    assert http._tls is not None
    assert http._tls.verify_mode is ssl.CERT_REQUIRED
    assert http._port == 443


