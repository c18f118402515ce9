# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import asyncio
from collections.abc import Mapping

import numpy as np
import pytest

from edge_unit.client import MAX_MESH_BYTES, MasterClient
from edge_unit.http import Answer
from shared.errors import MasterRefused, MasterUnreachable, WireError
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


class FakeHttp:
    """Answers what a test wants, and remembers what it was asked."""

    def __init__(self, *answers: Answer | Exception) -> None:
        self._answers = iter(answers)
        self.tokens: list[str] = []
        self.max_bytes = 0
        self.closed = False

    async def request(
        self, method: str, path: str, headers: Mapping[str, str], body: bytes, timeout_s: float, max_bytes: int
    ) -> Answer:
        self.tokens.append(headers["Authorization"])
        self.max_bytes = max_bytes
        answer = next(self._answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def close(self) -> None:
        self.closed = True


def client_of(*answers: Answer | Exception) -> MasterClient:
    return MasterClient("http://master:1", lambda: TOKEN, http=FakeHttp(*answers))


async def test_a_refusal_has_its_status_and_reason() -> None:
    async with client_of(Answer(409, b'{"detail":"unit 1: this session is over"}')) as client:
        with pytest.raises(MasterRefused) as caught:
            await client.update(update())
    assert caught.value.status == 409
    assert str(caught.value) == "http://master:1/update: 409: unit 1: this session is over"


async def test_a_long_reason_is_cut() -> None:
    async with client_of(Answer(500, b"\xff" * 100_000)) as client:
        with pytest.raises(MasterRefused) as caught:
            await client.update(update())
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("answer", [Answer(200, b"<html>"), Answer(200, b""), Answer(200, b"\x80")])
async def test_nonsense_is_a_wire_error(answer: Answer) -> None:
    async with client_of(answer) as client:
        with pytest.raises(WireError):
            await client.update(update())


async def test_a_redirection_is_not_followed() -> None:
    async with client_of(Answer(307, b"")) as client:
        with pytest.raises(MasterRefused, match="307"):
            await client.update(update())


async def test_a_silent_master_is_unreachable() -> None:
    async with client_of(MasterUnreachable("no answer")) as client:
        with pytest.raises(MasterUnreachable, match="no answer"):
            await client.update(update())


async def test_the_token_is_read_anew_when_asked_and_the_connections_closed() -> None:
    tokens = iter(("first-token-0123456789", "second-token-0123456789"))
    http = FakeHttp(*[Answer(404, b"gone")] * 3)
    async with MasterClient("http://master:1", lambda: next(tokens), http=http) as client:
        for _ in range(2):
            with pytest.raises(MasterRefused):
                await client.update(update())
        await client.authorize()
        with pytest.raises(MasterRefused):
            await client.update(update())
    assert http.tokens == ["Bearer first-token-0123456789"] * 2 + ["Bearer second-token-0123456789"]
    assert http.closed


async def test_a_mesh_may_be_longer_than_other_answers() -> None:
    http = FakeHttp(Answer(200, b"mesh"), Answer(200, b"\xc0"))
    async with MasterClient("http://master:1", lambda: TOKEN, http=http) as client:
        assert await client.mesh("0" * 64) == b"mesh"
        assert http.max_bytes == MAX_MESH_BYTES
        with pytest.raises(WireError):
            await client.robot(0, 1.0)
        assert http.max_bytes == MAX_ANSWER_BYTES


async def test_a_cell_that_is_no_document_is_refused() -> None:
    async with client_of(Answer(200, b"\x93\x01\x02\x03")) as client:
        with pytest.raises(WireError, match="expected a document"):
            await client.cell_document()


@pytest.mark.parametrize("count", [0, 100, 1000])
async def test_an_update_with_all_headers_costs_at_most_4_bytes_a_voxel_and_800(count: int) -> None:
    """Measured at the socket: the unit's request alone with room to spare, and with the master's answer too."""
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
    # The master's headers are some 70 bytes, see tests/master_server.
    assert len(received) + len(answer) + 70 <= 4 * count + 800
