# SPDX-License-Identifier: Apache-2.0
"""Size of an update on the wire, counted between a real client and a real master."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from edge_unit.uplink.client import MasterClient
from shared.camera import Intrinsics
from shared.clock import monotonic_ns
from shared.messages import CONTRACT_MINOR, CONTRACT_VERSION, Health, InitializeRequest, UpdateRequest
from shared.timebase import Exchange
from shared.wire import keys_to_bytes
from tests.system.cluster import Cluster, write_cell

pytestmark = pytest.mark.patient


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    folder = tmp_path_factory.mktemp("master")
    with Cluster(folder, write_cell(folder)) as cluster:
        cluster.start_master()
        yield cluster


class Counter:
    """A proxy that counts the bytes of both directions."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._pumps: list[asyncio.Task[None]] = []
        self.bytes = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there_reader, there_writer = await asyncio.open_connection("127.0.0.1", self._port)
        for source, sink in ((reader, there_writer), (there_reader, writer)):
            self._pumps.append(asyncio.ensure_future(self._pump(source, sink)))

    async def _pump(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await source.read(65536):
                self.bytes += len(data)
                sink.write(data)
        sink.close()

    async def close(self) -> None:
        await asyncio.gather(*self._pumps)


@pytest.mark.parametrize("count", [0, 100, 1000])
async def test_an_update_and_its_answer_cost_at_most_4_bytes_a_voxel_and_800(cluster: Cluster, count: int) -> None:
    counter = Counter(cluster.port)
    proxy = await asyncio.start_server(counter.serve, "127.0.0.1", 0)
    url = f"http://127.0.0.1:{proxy.sockets[0].getsockname()[1]}"
    token = Path(cluster.unit_token_file).read_text().strip()
    async with MasterClient(url, lambda: token) as client:
        slot = await client.initialize(
            InitializeRequest(
                contract=CONTRACT_VERSION,
                contract_minor=CONTRACT_MINOR,
                serial="A",
                intrinsics=Intrinsics(8, 6, 10.0, 10.0, 4.0, 3.0),
                sent_at_ns=monotonic_ns(),
            )
        )
        now_ns = monotonic_ns()
        update = UpdateRequest(
            id=slot.id,
            session=slot.session,
            sequence=10**6,
            captured_at_ns=now_ns,
            sent_at_ns=now_ns,
            exchange=Exchange(now_ns, now_ns, now_ns, now_ns),
            versions=slot.versions,
            keys=keys_to_bytes(np.arange(count, dtype=np.uint32)),
            health=Health(
                valid_share=0.87,
                agreeing_share=0.93,
                residual_share=0.01,
                static_share=0.5,
                process_ms=8.123,
                frame=10**6,
            ),
            joints_until_ns=now_ns,
        )
        counter.bytes = 0
        await client.update(update)
        assert 4 * count < counter.bytes <= 4 * count + 800
    await counter.close()
    proxy.close()
    await proxy.wait_closed()
