# SPDX-License-Identifier: Apache-2.0
"""The internals of uvicorn that we rely on, which no version promises. These must pass before the cap is raised.

`GuardedHttp`, `ReaderSocket` and `Acceptor` are built on them. Here stand uvicorn's own classes, without ours, at a
transport that only keeps what it was told.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

from master_server import logs
from master_server.server.connection_guard import NOISE, GuardedHttp
from master_server.server.latest_only_websocket import SERVER_OPTIONS, ReaderSocket

PYPROJECT = Path(__file__).parents[3] / "pyproject.toml"

REQUEST = b"POST /update HTTP/1.1\r\nHost: master\r\nContent-Length: 3\r\n\r\nabc"
CHUNKED = (
    b"POST /update HTTP/1.1\r\nHost: master\r\nTransfer-Encoding: chunked\r\nTrailer: X-Late\r\n\r\n"
    b"3\r\nabc\r\n0\r\nX-Late: 1\r\n\r\n"
)
UPGRADE = (
    b"GET /stream HTTP/1.1\r\nHost: master\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


class FakeTransport(asyncio.Transport):
    def __init__(self) -> None:
        super().__init__()
        self.written = bytearray()
        self.closing = False
        self.aborted = False
        self.protocol: Any = None

    def write(self, data: Any) -> None:
        self.written += data

    def close(self) -> None:
        self.closing = True

    def abort(self) -> None:
        self.aborted = self.closing = True

    def is_closing(self) -> bool:
        return self.closing

    def set_protocol(self, protocol: Any) -> None:
        self.protocol = protocol

    def get_protocol(self) -> Any:
        return self.protocol

    def pause_reading(self) -> None:
        pass

    def resume_reading(self) -> None:
        pass


class Recording(HttpToolsProtocol):
    """Record the calls of the methods that our class overrides."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.called: list[str] = []

    def on_message_begin(self) -> None:
        self.called.append("begin")
        super().on_message_begin()

    def on_header(self, name: bytes, value: bytes) -> None:
        self.called.append(f"header {name.decode().lower()}")
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self.called.append("headers complete")
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        self.called.append("complete")
        super().on_message_complete()

    def handle_websocket_upgrade(self) -> None:
        self.called.append("upgrade")
        super().handle_websocket_upgrade()

    def send_400_response(self, msg: str) -> None:
        self.called.append("400")
        super().send_400_response(msg)


Http = tuple[Recording, FakeTransport]


async def app(scope: Any, receive: Any, send: Any) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        await asyncio.Event().wait()
    while (await receive())["more_body"]:
        pass
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
    await send({"type": "http.response.body", "body": b""})


def config_of(**options: Any) -> uvicorn.Config:
    return uvicorn.Config(app, log_config=None, access_log=False, **{"http": HttpToolsProtocol, **options})


async def ended(state: ServerState) -> None:
    """End all tasks of the protocols."""
    for task in tuple(state.tasks):
        task.cancel()
    await asyncio.gather(*state.tasks, return_exceptions=True)


def http(state: ServerState, **options: Any) -> Http:
    protocol, transport = Recording(config_of(**options), state, {}), FakeTransport()
    protocol.connection_made(transport)
    return protocol, transport


async def answered(transport: FakeTransport, begin: bytes) -> None:
    for _ in range(100):
        if transport.written.startswith(begin):
            return
        await asyncio.sleep(0)
    raise AssertionError(f"expected {begin!r}, got {bytes(transport.written)!r}")


async def test_uvicorn_calls_a_method_for_each_part_of_a_request_in_order() -> None:
    state = ServerState()
    protocol, transport = http(state)
    assert protocol.transport is transport
    assert protocol.loop is asyncio.get_running_loop()
    for byte in range(len(REQUEST)):
        protocol.data_received(REQUEST[byte : byte + 1])
    expected = ["begin", "header host", "header content-length", "headers complete", "complete"]
    assert protocol.called == expected
    await answered(transport, b"HTTP/1.1 200")
    protocol.data_received(REQUEST)
    assert protocol.called == 2 * expected
    protocol.connection_lost(None)
    await ended(state)


async def test_trailers_arrive_as_headers() -> None:
    state = ServerState()
    protocol, _ = http(state)
    protocol.data_received(CHUNKED)
    assert protocol.called.index("header x-late") > protocol.called.index("headers complete")
    protocol.connection_lost(None)
    await ended(state)


async def test_a_refusal_is_written_and_closes(caplog: pytest.LogCaptureFixture) -> None:
    protocol, transport = http(ServerState())
    protocol.send_400_response("Expected a head.")
    assert transport.written.startswith(b"HTTP/1.1 400")
    assert transport.written.endswith(b"Expected a head.")
    assert transport.closing
    protocol, transport = http(ServerState())
    protocol.data_received(b"no request\r\n\r\n")
    assert protocol.called[-1] == "400"
    assert [record.getMessage() for record in caplog.records] == [NOISE[0]]
    assert caplog.records[0].name == "uvicorn.error"


async def test_an_unsupported_upgrade_logs_the_other_noise(caplog: pytest.LogCaptureFixture) -> None:
    state = ServerState()
    protocol, _ = http(state)
    protocol.data_received(UPGRADE.replace(b"websocket", b"h2c"))
    assert [record.getMessage() for record in caplog.records] == [NOISE[1]]
    protocol.connection_lost(None)
    await ended(state)


async def test_an_upgrade_hands_the_transport_to_the_websocket_of_the_configuration(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "uvicorn.error")
    state = ServerState()
    protocol, transport = http(state, ws=WebSocketsSansIOProtocol)
    protocol.data_received(UPGRADE)
    assert protocol.called[-1] == "upgrade"
    assert isinstance(transport.get_protocol(), WebSocketsSansIOProtocol)
    assert transport.get_protocol().transport is transport
    assert protocol not in state.connections
    await answered(transport, b"HTTP/1.1 101")
    # The log filters this line, since it has the whole address.
    assert any(logs.ACCESS_LINE in str(record.msg) for record in caplog.records)
    transport.get_protocol().connection_lost(None)
    await ended(state)


async def socket_at(transport: FakeTransport, state: ServerState, **options: Any) -> WebSocketsSansIOProtocol:
    """Return an accepted WebSocket."""
    protocol = WebSocketsSansIOProtocol(config_of(ws=WebSocketsSansIOProtocol, **options), state, {})
    protocol.connection_made(transport)
    assert protocol.transport is transport
    protocol.data_received(UPGRADE)
    await answered(transport, b"HTTP/1.1 101")
    transport.written.clear()
    return protocol


async def test_a_message_waits_while_the_transport_is_full() -> None:
    """This makes a slot of one: the next sender finds the newest."""
    state, transport = ServerState(), FakeTransport()
    protocol = await socket_at(transport, state)
    protocol.pause_writing()
    sending = asyncio.ensure_future(protocol.send({"type": "websocket.send", "bytes": b"map"}))
    done, _ = await asyncio.wait((sending,), timeout=0.01)
    assert not done
    assert not transport.written
    protocol.resume_writing()
    await sending
    assert transport.written.endswith(b"map")
    protocol.connection_lost(None)
    await ended(state)


async def test_a_close_is_sent_as_a_message_and_keeps_the_transport_open() -> None:
    state, transport = ServerState(), FakeTransport()
    protocol = await socket_at(transport, state)
    await protocol.send({"type": "websocket.close", "code": 1000})
    assert transport.written
    assert not transport.closing
    protocol.connection_lost(None)
    await ended(state)


async def test_a_missing_pong_calls_the_overridden_method(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state, transport, timers = ServerState(), FakeTransport(), []
    loop = asyncio.get_running_loop()

    def call_later(delay_s: float, callback: Callable[..., object], *args: Any) -> asyncio.TimerHandle:
        timers.append((delay_s, callback))
        return asyncio.TimerHandle(loop.time(), callback, args, loop)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "call_later", call_later)
        protocol = await socket_at(transport, state, ws_ping_interval=3.0, ws_ping_timeout=4.0)
        ((interval_s, ping),) = timers
        ping()
        (_, (timeout_s, give_up)) = timers
    assert (interval_s, timeout_s) == (3.0, 4.0)
    assert transport.written
    assert give_up == protocol.keepalive_timeout
    give_up()
    assert transport.closing
    assert not transport.aborted
    protocol.connection_lost(None)
    await ended(state)


def test_the_configuration_accepts_our_protocols() -> None:
    config = uvicorn.Config(app, http=GuardedHttp, log_config=None, **SERVER_OPTIONS)
    config.load()
    assert config.http_protocol_class is GuardedHttp
    assert config.ws_protocol_class is ReaderSocket
    found = {name: getattr(config, name) for name in SERVER_OPTIONS}
    assert found == SERVER_OPTIONS


async def test_a_server_without_sockets_has_the_attributes_that_the_acceptor_uses() -> None:
    config = config_of(lifespan="off")
    config.load()
    server = uvicorn.Server(config)
    server.lifespan = config.lifespan_class(config)
    await server.startup([])
    try:
        assert server.servers == []
        protocol = GuardedHttp(config, server.server_state, server.lifespan.state)
        transport = FakeTransport()
        protocol.connection_made(transport)
        assert protocol in server.server_state.connections
        transport.closing = True
        protocol.connection_lost(None)
        assert protocol not in server.server_state.connections
    finally:
        await server.shutdown([])


@pytest.mark.parametrize(("ours", "base"), [(GuardedHttp, HttpToolsProtocol), (ReaderSocket, WebSocketsSansIOProtocol)])
def test_our_classes_override_no_attribute_by_accident(
    ours: type[asyncio.Protocol], base: type[asyncio.Protocol]
) -> None:
    """A newer base class may use one of our names, which we would then override by accident."""
    overridden = {name for name in vars(ours) if name in dir(base) and not name.startswith("__")}
    own = {name for name in vars(ours) if not name.startswith("__")} - overridden
    assert (
        overridden
        == {
            GuardedHttp: {
                "connection_made",
                "connection_lost",
                "data_received",
                "on_message_begin",
                "on_header",
                "on_headers_complete",
                "on_message_complete",
                "handle_websocket_upgrade",
            },
            ReaderSocket: {"connection_made", "connection_lost", "send", "keepalive_timeout"},
        }[ours]
    )
    # Attributes of an instance are in no `dir` of its class.
    source = inspect.getsource(base)
    assert [name for name in own if re.search(rf"self\.{name}\b", source)] == []


def test_the_version_is_capped() -> None:
    (line,) = [line for line in PYPROJECT.read_text().splitlines() if '"uvicorn' in line]
    major, minor = (int(part) for part in uvicorn.__version__.split(".")[:2])
    assert f'"uvicorn>={major}.{minor},<{major}.{minor + 1}"' in line
