# SPDX-License-Identifier: Apache-2.0
"""A real master, units that consist only of HTTP requests, and readers of `/stream` that must stay informed."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import psutil
import pytest
from websockets.asyncio.client import ClientConnection, connect

from master_server.api.responses import StreamMessage
from shared.clock import NS_PER_S, monotonic_ns
from shared.messages import InitializeAnswer, UpdateRequest
from shared.timebase import Exchange
from shared.wire import MEDIA_TYPE, decode, decode_update_answer, encode, encode_update, pack_seen
from tests.master_server.fakes import AT_ORIGIN, MS, FakeUnit, master
from tests.system.cluster import Cluster, write_cell

STALE_AFTER_S = 0.3
PUSHED_WITHIN_S = 0.05
SLACK_S = 0.1
"""This process and the master share a busy machine."""
PERIOD_S = 1.0 / 30.0


class HttpUnit:
    """Registers and reports like a unit, from an address of its own."""

    def __init__(self, cluster: Cluster, number: int) -> None:
        self.ip = f"127.0.0.{number + 1}"
        self._fake = FakeUnit(master(), self.ip, f"S{number}")
        token = Path(cluster.unit_token_file).read_text().strip()
        headers = {"Authorization": f"Bearer {token}", "Content-Type": MEDIA_TYPE, "Accept": MEDIA_TYPE}
        transport = httpx.AsyncHTTPTransport(local_address=self.ip)
        self.client = httpx.AsyncClient(base_url=cluster.url, headers=headers, transport=transport)

    async def join(self) -> None:
        sent_ns = monotonic_ns()
        response = await self.client.post("/initialize", content=encode(self._fake.introduction(sent_ns)))
        answer = decode(InitializeAnswer, response.content)
        self._fake.initialized = answer
        self._fake.exchange = Exchange(sent_ns, answer.received_at_ns, answer.answered_at_ns, monotonic_ns())
        pose = {"T_world_camera": AT_ORIGIN, "origin": "configured"}
        put = await self.client.put(f"/units/{answer.id}/pose", content=msgpack.packb(pose))
        self._fake.versions = answer.versions.model_copy(update=msgpack.unpackb(put.content))

    async def update(self, *keys: int) -> UpdateRequest:
        seen = pack_seen(np.ones((20, 20, 20), bool), 0.1)
        request = self._fake.request(monotonic_ns(), keys, seen, age_ns=MS)
        response = await self.client.post("/update", content=encode_update(request))
        assert response.status_code == 200, response.text
        answer = decode_update_answer(response.content)
        self._fake.exchange = Exchange(request.sent_at_ns, answer.received_at_ns, answer.answered_at_ns, monotonic_ns())
        return request


@pytest.fixture
async def cluster(tmp_path: Path) -> AsyncIterator[Cluster]:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        cluster.start_master("--set", f"settings.stale_after_s={STALE_AFTER_S}")
        yield cluster


@asynccontextmanager
async def two_units(cluster: Cluster) -> AsyncIterator[tuple[HttpUnit, HttpUnit]]:
    first, second = HttpUnit(cluster, 1), HttpUnit(cluster, 2)
    async with first.client, second.client:
        await first.join()
        await second.join()
        yield first, second


def reader_of(cluster: Cluster, query: str = "?form=keys") -> connect:
    url = cluster.url.replace("http", "ws") + "/stream" + query
    return connect(url, additional_headers={"Authorization": cluster.operator.headers["Authorization"]}, proxy=None)


async def heard(reader: ClientConnection) -> dict[str, Any]:
    message = await reader.recv()
    assert isinstance(message, bytes)
    found: dict[str, Any] = msgpack.unpackb(message)
    StreamMessage.model_validate(found)
    return found


async def until_complete(reader: ClientConnection, *voxels: int) -> None:
    while not ((message := await heard(reader))["complete"] and message["voxels"] == list(voxels)):
        pass


async def test_silent_units_are_reported_in_time_without_any_post(cluster: Cluster) -> None:
    async with two_units(cluster) as (first, second), reader_of(cluster) as reader:
        await first.update(1)
        await second.update(2)
        await until_complete(reader, 1, 2)
        last = await first.update(1)
        # The first unit is dead from here on; the second still reports, and later stops, too.
        while (message := await heard(reader))["complete"]:
            await second.update(2)
        assert last.captured_at_ns is not None
        late_s = (monotonic_ns() - last.captured_at_ns) / NS_PER_S - STALE_AFTER_S
        assert -0.002 < late_s < PUSHED_WITHIN_S + SLACK_S
        assert message["voxels"] == [2]
        assert [unit["state"] for unit in message["units"]] == ["stale", "live"]
        last = await second.update(2)
        while (message := await heard(reader))["voxels"]:
            pass
        assert last.captured_at_ns is not None
        late_s = (monotonic_ns() - last.captured_at_ns) / NS_PER_S - STALE_AFTER_S
        assert -0.002 < late_s < PUSHED_WITHIN_S + SLACK_S
        assert len(message["reasons"]) == 2


async def test_from_capture_to_reader_within_a_frame(cluster: Cluster) -> None:
    async with two_units(cluster) as (first, second), reader_of(cluster) as reader:
        await first.update(1)
        await second.update(2)
        await until_complete(reader, 1, 2)
        delays_s = []
        for key in range(10, 60):
            request = await first.update(key)
            while key not in (await heard(reader))["voxels"]:
                pass
            assert request.captured_at_ns is not None
            delays_s.append((monotonic_ns() - request.captured_at_ns) / NS_PER_S)
            await second.update(2)
        assert sorted(delays_s)[len(delays_s) // 2] < PERIOD_S


async def test_readers_that_do_not_read_cost_no_memory(cluster: Cluster) -> None:
    process = psutil.Process(cluster.processes[0].pid)
    async with two_units(cluster) as (first, _), reader_of(cluster) as reader:
        wall = range(5000)
        deaf = [await reader_of(cluster).__aenter__() for _ in range(8)]
        for connection in deaf:
            connection.transport.pause_reading()
        for step in range(30):
            await first.update(step, *wall[100:])
            await heard(reader)
        before = process.memory_info().rss
        for step in range(200):
            await first.update(step % 100, *wall[100:])
            await heard(reader)
        # If kept, these would be 8 readers x 200 messages x 20 kB = 32 MB.
        assert process.memory_info().rss - before < 8 * 2**20
        for connection in deaf:
            connection.transport.abort()
