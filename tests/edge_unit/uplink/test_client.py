# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import asyncio
from collections.abc import Callable

import httpx
import numpy as np
import pytest

from edge_unit.uplink.client import MAX_MESH_BYTES, MasterClient
from shared.errors import ConfigError, MasterRefused, MasterUnreachable, UplinkError, WireError
from shared.messages import Health, JointSample, UpdateAnswer, UpdateRequest, Versions
from shared.timebase import Exchange
from shared.wire import MAX_ANSWER_BYTES, decode_update, encode_update_answer, keys_to_bytes

LATE_NS = 10**9 * 3600 * 24 * 365
TOKEN = "x" * 43
VERSIONS = Versions(settings=1000, lattice=1000, cell=1000, pose=1000)


def update(count: int = 0) -> UpdateRequest:
    return UpdateRequest(
        id=64,
        session=2**32 - 1,
        sequence=10**8,
        captured_at_ns=LATE_NS,
        sent_at_ns=LATE_NS,
        exchange=Exchange(LATE_NS, LATE_NS, LATE_NS, LATE_NS),
        versions=VERSIONS,
        keys=keys_to_bytes(np.arange(count, dtype=np.uint32)),
        health=Health(
            valid_share=0.871,
            agreeing_share=0.95,
            residual_share=-0.01,
            static_share=0.5,
            process_ms=8.123,
            frame=10**8,
        ),
        joints_until_ns=LATE_NS,
    )


def client_of(handler: Callable[[httpx.Request], httpx.Response]) -> MasterClient:
    return MasterClient("http://master:1", lambda: TOKEN, transport=httpx.MockTransport(handler))


async def refused(answer: httpx.Response) -> UplinkError | WireError:
    async with client_of(lambda _: answer) as client:
        with pytest.raises((UplinkError, WireError)) as caught:
            await client.update(update())
    return caught.value


async def test_a_refusal_has_its_status_and_reason() -> None:
    error = await refused(httpx.Response(409, json={"detail": "unit 1: this session is over"}))
    assert isinstance(error, MasterRefused)
    assert error.status == 409
    assert str(error) == "http://master:1/update: 409: unit 1: this session is over"


async def test_an_invalid_answer_is_a_wire_error() -> None:
    assert isinstance(await refused(httpx.Response(200, content=b"<html>")), WireError)
    assert isinstance(await refused(httpx.Response(200, content=b"\0" * (MAX_ANSWER_BYTES + 1))), WireError)


SILENCE = (httpx.ConnectError("no route"), httpx.ReadTimeout(""), httpx.RemoteProtocolError("x"))


@pytest.mark.parametrize("error", SILENCE)
async def test_a_silent_master_is_unreachable(error: httpx.HTTPError) -> None:
    def handler(_: httpx.Request) -> httpx.Response:
        raise error

    async with client_of(handler) as client:
        with pytest.raises(MasterUnreachable, match="http://master:1/update: "):
            await client.update(update())


async def test_authorize_reads_the_token_again() -> None:
    tokens = iter(("first-token-0123456789", "second-token-0123456789"))
    seen = []

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request.headers["authorization"])
        return httpx.Response(404, text="gone")

    async with MasterClient("http://master:1", lambda: next(tokens), transport=httpx.MockTransport(handler)) as client:
        for _ in range(2):
            with pytest.raises(MasterRefused):
                await client.update(update())
        await client.authorize()
        with pytest.raises(MasterRefused):
            await client.update(update())
    assert seen == ["Bearer first-token-0123456789"] * 2 + ["Bearer second-token-0123456789"]


async def test_a_mesh_that_is_too_long_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge_unit.uplink.client.MAX_MESH_BYTES", 1000)
    assert MAX_MESH_BYTES > 10**6
    async with client_of(lambda _: httpx.Response(200, content=b"\0" * 1001)) as client:
        with pytest.raises(WireError, match="at most 1000 bytes"):
            await client.mesh("0" * 64)


async def test_a_cell_that_is_no_document_is_refused() -> None:
    async with client_of(lambda _: httpx.Response(200, content=b"\x93\x01\x02\x03")) as client:
        with pytest.raises(WireError, match="expected a document"):
            await client.cell_document()


def test_a_master_without_a_host_is_refused() -> None:
    with pytest.raises(ConfigError, match="master_url"):
        MasterClient("http://", lambda: TOKEN)


@pytest.mark.parametrize("count", [0, 100, 1000])
async def test_an_update_with_all_headers_costs_at_most_4_bytes_a_voxel_and_800(count: int) -> None:
    """Count the bytes at the socket: of the request, which has a limit of its own, and of request and answer."""
    joints = tuple(JointSample(LATE_NS + i, (0.1,) * 7, None) for i in range(2))
    answer = encode_update_answer(
        UpdateAnswer(versions=VERSIONS, received_at_ns=LATE_NS, answered_at_ns=LATE_NS, joints=joints)
    )
    received = bytearray()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        lengths = [line for line in head.lower().split(b"\r\n") if line.startswith(b"content-length")]
        body = await reader.readexactly(int(lengths[0].split()[1]))
        received.extend(head + body)
        assert decode_update(body) == update(count)
        writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n" % len(answer) + answer)
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server, MasterClient(f"http://127.0.0.1:{port}", lambda: TOKEN, "127.0.0.9") as client:
        assert (await client.update(update(count))).joints[1].at_ns == LATE_NS + 1
    assert len(received) <= 4 * count + 520
    # The master's headers have about 70 bytes, see tests/master_server.
    assert len(received) + len(answer) + 70 <= 4 * count + 800
