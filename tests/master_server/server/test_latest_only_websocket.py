# SPDX-License-Identifier: Apache-2.0
"""`/stream` over a socket: access, messages, and readers that do not read."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any

import msgpack
import pytest
import uvicorn
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidStatus

from master_server.api.map_stream import MAX_LISTENERS, Stream
from master_server.api.routes.sockets import TOKEN_REPLACED
from master_server.app import Application, add_viewer, make_app
from master_server.core import Master
from master_server.security import Access, Role
from master_server.server.latest_only_websocket import CLOSE_S, MESSAGE_MAX_BYTES, SERVER_OPTIONS
from shared.clock import NS_PER_S, monotonic_ns
from shared.waiting import within
from tests.master_server.fakes import MS, joined, master, sees_all

pytestmark = pytest.mark.alone

UNIT = "unit-token-0123456789"
OPERATOR = "operator-token-0123456789"
WAIT_S = 5.0


@dataclass
class Place:
    """A master behind a socket of loopback."""

    master: Master
    stream: Stream
    port: int
    app: Application

    def connect(self, query: str = "", token: str | None = UNIT, path: str = "/stream", **more: Any) -> connect:
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        url = f"ws://127.0.0.1:{self.port}{path}{query}"
        return connect(url, additional_headers=headers, proxy=None, **more)


@asynccontextmanager
async def serving(access: Access | None = None, **options: Any) -> AsyncIterator[Place]:
    one = master(stale_after_s=60.0)
    app = make_app(one, access or Access(UNIT.encode(), OPERATOR.encode()))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        config = uvicorn.Config(
            app, log_config=None, access_log=False, timeout_graceful_shutdown=1, **{**SERVER_OPTIONS, **options}
        )
        server = uvicorn.Server(config)
        task = asyncio.ensure_future(server.serve([listener]))
        try:
            yield Place(one, app.services.stream, listener.getsockname()[1], app)
        finally:
            server.should_exit = True
            await task


async def received(connection: ClientConnection) -> dict[str, Any]:
    message = await connection.recv()
    found: dict[str, Any] = msgpack.unpackb(message) if isinstance(message, bytes) else json.loads(message)
    return found


async def closing_code(connection: ClientConnection) -> int | None:
    """Return the master's close code, after its last messages."""
    with suppress(ConnectionClosed):
        async for _ in connection:
            pass
    return connection.close_code


async def refused(place: Place, query: str = "", token: str | None = UNIT, **more: Any) -> tuple[int, str]:
    with pytest.raises(InvalidStatus) as caught:
        async with place.connect(query, token, **more):
            pass
    assert caught.value.response.body is not None
    return caught.value.response.status_code, json.loads(bytes(caught.value.response.body))["detail"]


async def test_a_reader_receives_the_map_as_it_changes() -> None:
    async with serving() as place, place.connect("?form=keys") as reader:
        assert (await received(reader))["reasons"] == ["there is no unit"]
        joined(place.master, 1, monotonic_ns()).update(monotonic_ns(), [3, 5], seen=sees_all(place.master), age_ns=MS)
        message = await received(reader)
        while not message["complete"]:
            message = await received(reader)
        assert message["voxels"] == [3, 5]


async def test_json_on_request() -> None:
    async with serving() as place, place.connect("?encoding=json&unseen=true&form=centres") as reader:
        message = await reader.recv()
        assert isinstance(message, str)
        assert len(json.loads(message)["unseen"]["blocks"]) == 1000


@pytest.mark.parametrize("token", [UNIT, OPERATOR])
async def test_a_browser_offers_its_token_as_a_subprotocol_and_does_not_get_it_back(token: str) -> None:
    async with serving() as place:
        async with place.connect("", None, subprotocols=["cellwatch", f"bearer.{token}"]) as reader:
            assert reader.subprotocol == "cellwatch"
            await received(reader)
        async with place.connect("", None, subprotocols=[f"bearer.{token}"]) as reader:
            assert reader.subprotocol is None
        assert (await refused(place, "", None, subprotocols=["cellwatch", "bearer.wrong-token-0123456789"]))[0] == 401


async def test_a_refused_reader_receives_the_reason() -> None:
    async with serving() as place:
        assert (await refused(place, "", None))[0] == 401
        assert (await refused(place, "", "wrong-token-0123456789"))[0] == 401
        status, detail = await refused(place, f"?token={UNIT}")
        assert status == 400
        assert "bearer.<token>" in detail
        assert UNIT not in detail
        for query in ("?form=cubes", "?encoding=xml", "?from=keys"):
            status, detail = await refused(place, query)
            assert status == 422
            assert query[1:].partition("=")[0] in detail
        assert len(place.stream) == 0


async def test_public_reads_need_no_token() -> None:
    access = Access(UNIT.encode(), OPERATOR.encode(), public_reads=True)
    async with serving(access) as place, place.connect("", None) as reader:
        await received(reader)


async def test_the_number_of_readers_is_bounded_and_a_closed_one_frees_its_place() -> None:
    async with serving() as place:
        readers = [await place.connect() for _ in range(MAX_LISTENERS)]
        assert (await refused(place))[0] == 503
        for reader in readers:
            await reader.close()
        async with place.connect() as reader:
            await received(reader)
            assert len(place.stream) == 1


async def test_messages_of_a_reader_are_ignored_unless_too_large() -> None:
    async with serving() as place:
        async with place.connect() as reader:
            await reader.send("hello")
            await reader.send(b"\0" * 100)
            for _ in range(3):
                await received(reader)
            await reader.send("x" * (MESSAGE_MAX_BYTES + 1))
            assert await closing_code(reader) == 1009
        async with place.connect() as reader:
            await received(reader)


@asynccontextmanager
async def deaf(place: Place) -> AsyncIterator[socket.socket]:
    """Yield a reader that is accepted and then never reads; with the smallest buffer possible."""
    with socket.socket() as raw:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        raw.setblocking(False)
        loop = asyncio.get_running_loop()
        await loop.sock_connect(raw, ("127.0.0.1", place.port))
        lines = (
            "GET /stream HTTP/1.1", "Host: master", "Upgrade: websocket", "Connection: Upgrade",
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13",
            f"Authorization: Bearer {UNIT}", "", "",
        )  # fmt: skip
        await loop.sock_sendall(raw, "\r\n".join(lines).encode())
        assert (await loop.sock_recv(raw, 12)) == b"HTTP/1.1 101"
        yield raw


async def test_a_reader_that_does_not_read_holds_one_message_and_delays_nobody() -> None:
    async with serving() as place, deaf(place), place.connect("?form=keys") as reader:
        unit = joined(place.master, 1, monotonic_ns())
        delays_ns = []
        for step in range(60):
            unit.update(monotonic_ns(), range(2000 + step), age_ns=MS)
            changed_ns = monotonic_ns()
            while len((await received(reader))["voxels"]) != 2000 + step:
                pass
            delays_ns.append(monotonic_ns() - changed_ns)
        idle = min(place.stream.listeners, key=lambda listener: listener.sent)
        # Each message is about 20 kB: the kernel took the first few, one waits, and no others were made for it.
        assert idle.sent <= 10
        assert sorted(delays_ns)[len(delays_ns) // 2] < 33 * MS


async def test_a_reader_that_answers_no_pings_is_disconnected() -> None:
    began_ns = monotonic_ns()
    async with serving(ws_ping_interval=0.2, ws_ping_timeout=0.2) as place, deaf(place):
        unit = joined(place.master, 1, monotonic_ns())

        async def until_alone() -> None:
            while len(place.stream):
                unit.update(monotonic_ns(), range(4000), age_ns=MS)
                await asyncio.sleep(0.01)

        assert len(place.stream) == 1
        assert await within(WAIT_S, until_alone())
    assert monotonic_ns() - began_ns < WAIT_S * NS_PER_S


async def test_a_stopping_master_closes_its_streams() -> None:
    async with serving() as place:
        reader = await place.connect()
        await received(reader)
    assert await closing_code(reader) == 1012


async def test_a_stream_ends_with_the_token_that_it_was_opened_with() -> None:
    access = Access(UNIT.encode(), OPERATOR.encode())
    new = "another-token-0123456789"
    async with serving(access) as place, place.connect() as first, place.connect(token=OPERATOR) as other:
        await received(first)
        began_ns = monotonic_ns()
        access.replace(Role.UNIT, new.encode())
        assert await closing_code(first) == TOKEN_REPLACED == 1008
        assert first.close_reason == "the token was replaced"
        assert monotonic_ns() - began_ns < CLOSE_S * NS_PER_S
        assert len(place.stream) == 1
        await received(other)
        await received(other)
        assert (await refused(place))[0] == 401
        async with place.connect(token=new) as again:
            await received(again)


async def test_a_viewer_connection_ends_with_its_token_too(monkeypatch: pytest.MonkeyPatch) -> None:
    async def silent(inner: ServerConnection) -> None:
        await inner.wait_closed()

    async def opened() -> None:
        pass

    access = Access(UNIT.encode(), OPERATOR.encode())
    async with serving(access) as place, serve(silent, "127.0.0.1", 0) as process:
        gate = add_viewer(place.app, {})
        monkeypatch.setattr(gate.host, "open", opened)
        monkeypatch.setattr(gate.host, "port", next(iter(process.sockets)).getsockname()[1])
        async with (
            place.connect(token=UNIT, path="/viewer/") as reader,
            place.connect(token=OPERATOR, path="/viewer/") as operator,
        ):
            access.replace(Role.OPERATOR, b"another-token-0123456789")
            assert await closing_code(operator) == TOKEN_REPLACED
            assert reader.close_code is None
            access.replace(Role.UNIT, b"one-more-token-0123456789")
            assert await closing_code(reader) == TOKEN_REPLACED


async def test_a_public_stream_outlives_every_token() -> None:
    access = Access(UNIT.encode(), OPERATOR.encode(), public_reads=True)
    async with serving(access) as place, place.connect() as reader:
        await received(reader)
        access.replace(Role.UNIT, b"another-token-0123456789")
        for _ in range(3):
            await received(reader)


async def test_a_reader_that_does_not_read_is_disconnected_with_its_token_too() -> None:
    access = Access(UNIT.encode(), OPERATOR.encode())
    async with serving(access, ws_ping_interval=None) as place, deaf(place) as raw:
        unit = joined(place.master, 1, monotonic_ns())
        (listener,) = place.stream.listeners

        async def until_it_is_behind() -> None:
            while place.stream.snapshot is None or place.stream.snapshot.number < listener.sent + 5:
                unit.update(monotonic_ns(), range(4000), age_ns=MS)
                await asyncio.sleep(0.02)

        assert await within(WAIT_S, until_it_is_behind())
        connections = [task for task in asyncio.all_tasks() if "run_asgi" in str(task.get_coro())]
        assert len(connections) == 1
        access.replace(Role.UNIT, b"another-token-0123456789")
        done, _ = await asyncio.wait(connections, timeout=2.0 * CLOSE_S)
        assert done
        assert len(place.stream) == 0

        async def until_its_end() -> None:
            with suppress(ConnectionResetError):
                while await asyncio.get_running_loop().sock_recv(raw, 2**16):
                    pass

        assert await within(WAIT_S, until_its_end())
