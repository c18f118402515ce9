# SPDX-License-Identifier: Apache-2.0
"""Load on a master: it equals the updates of units, and every failure of the master is counted."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from benchmarks import master
from benchmarks.load_generator.load import Plan, carry_out, map_is_right
from benchmarks.load_generator.traffic import SimpleUnit, View, captured_head, view
from benchmarks.reporting.report import Mark
from edge_unit.uplink.client import MasterClient
from shared.cell import Cell
from shared.errors import MasterUnreachable
from shared.lattice import Lattice
from shared.wire import decode_update, encode_update, keys_from_bytes
from simulation.world.world import DEMO_CELL

pytestmark = pytest.mark.alone

LATTICE = Lattice((-1.5, -1.5, -0.75), 0.05, (60, 60, 45))
BLOCKS = Lattice((-1.5, -1.5, -0.75), 0.1, (30, 30, 23))
ANSWER = msgpack.packb({"received_at_ns": 1, "answered_at_ns": 2, "joints": [(7, b"", None)]})

Answer = Callable[[int, bytes], tuple[int, bytes] | float | None]
"""Maps the number and bytes of a request to status and body, to seconds of delay before a good answer, or to None to
hang up.
"""


@asynccontextmanager
async def fake_master(answer: Answer) -> AsyncIterator[str]:
    """Serve answers at a free port."""
    count = 0
    serving: set[asyncio.Task[Any]] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal count
        task = asyncio.current_task()
        assert task is not None
        serving.add(task)
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
            while True:
                request = await reader.readuntil(b"\r\n\r\n")
                if b"Content-Length: " in request:
                    length = int(request.split(b"Content-Length: ")[1].split(b"\r\n")[0])
                    request += await reader.readexactly(length)
                found = answer(count, request)
                count += 1
                if found is None:
                    break
                if isinstance(found, float):
                    await asyncio.sleep(found)
                    found = (200, ANSWER)
                writer.write(b"HTTP/1.1 %d X\r\ncontent-length: %d\r\n\r\n%b" % (found[0], len(found[1]), found[1]))
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        for task in serving:
            task.cancel()
        await asyncio.gather(*serving)


async def counts(folder: Path, answer: Answer, **changes: Any) -> dict[str, Any]:
    """Return the counts of a load of one second on a fake master."""
    (folder / "token").write_text("t" * 40)
    async with fake_master(answer) as url:
        fields = {"units": 1, "voxels": 100, "seconds": 1.0, "warm_up_s": 0.0, "rate_hz": 30.0, **changes}
        plan = Plan(url, str(folder / "token"), str(DEMO_CELL), bare=True, **fields)
        return await asyncio.to_thread(carry_out, plan)


def good(number: int, request: bytes) -> tuple[int, bytes]:
    return 200, ANSWER


async def test_all_that_is_answered_counts(tmp_path: Path) -> None:
    sizes: list[int] = []

    def answer(number: int, request: bytes) -> tuple[int, bytes]:
        sizes.append(len(request))
        return 200, ANSWER

    found = await counts(tmp_path, answer, units=2)
    assert found["sent"] == found["counted"] == len(sizes) in range(58, 63)
    assert found["lost"] == 0
    assert found["bytes_out"] == sum(sizes)
    assert 0 < found["bytes_seen"] < sum(sizes) - 400 * len(sizes)
    assert found["bytes_in"] == len(sizes) * (len(ANSWER) + len(b"HTTP/1.1 200 X\r\ncontent-length: 52\r\n\r\n"))


async def test_a_refused_or_unanswered_update_is_lost(tmp_path: Path) -> None:
    refused = await counts(tmp_path, lambda n, _: (409, b"no") if n % 5 == 0 else (200, ANSWER))
    assert refused["lost"] == -(-refused["sent"] // 5)
    assert "409" in refused["trouble"]
    hung_up = await counts(tmp_path, lambda n, _: None if n == 3 else (200, ANSWER))
    assert hung_up["lost"] == 1
    assert hung_up["counted"] == hung_up["sent"] - 1
    silent = await counts(tmp_path, lambda n, _: 30.0 if n == 20 else (200, ANSWER))
    assert silent["lost"] == silent["sent"] - 20


async def test_a_stall_counts_for_all_that_would_have_come_meanwhile(tmp_path: Path) -> None:
    found = await counts(tmp_path, lambda n, _: 0.7 if n == 0 else 0.0)
    assert found["lost"] == 0
    assert found["max_ms"] > 600.0
    assert found["p50_ms"] > 100.0


async def test_without_a_rate_the_next_follows_the_answer(tmp_path: Path) -> None:
    found = await counts(tmp_path, lambda n, _: 0.02, units=4, rate_hz=None)
    # Fifty a second each on an idle machine; fewer on a busy one, but never more.
    assert 4 * 3 < found["counted"] <= 4 * 50


async def test_the_bytes_are_those_of_the_units_own_client() -> None:
    heard: list[bytes] = []

    def answer(number: int, request: bytes) -> None:
        heard.append(request)

    async with fake_master(answer) as url:
        head = await captured_head(url, "t%d" * 10)
        unit = SimpleUnit("127.0.0.2", view(0, 100, LATTICE, BLOCKS, 2.0), 0, head)
        request, _ = unit.request(5, 6)
        update = decode_update(request.partition(b"\r\n\r\n")[2])
        async with MasterClient(url, lambda: "t%d" * 10) as client:
            with pytest.raises(MasterUnreachable):
                await client.update(update)
    assert heard == [request]


def test_people_walk_and_cast_a_shadow() -> None:
    one = view(1, 1000, LATTICE, BLOCKS, 6.0)
    keys = [keys_from_bytes(each, LATTICE.cell_count) for each in one.keys]
    assert {len(each) for each in keys} == {1000}
    shared = [len(np.intersect1d(a, b)) for a, b in pairwise(keys)]
    assert 0 < min(shared) <= max(shared) < 1000
    assert len({each.bits for each in one.seen}) > len(keys) // 2


def test_a_unit_reports_seen_only_after_a_change() -> None:
    same = view(0, 100, LATTICE, BLOCKS, 2.0)
    still = View(same.keys[:1] * 2, same.seen[:1] * 2, same.seen_bytes[:1] * 2)
    unit = SimpleUnit("127.0.0.2", still, 0, b"%d\r\n\r\n")
    first, second = unit.request(1, 2), unit.request(3, 4)
    assert decode_update(first[0].partition(b"\r\n\r\n")[2]).seen is not None
    update = decode_update(second[0].partition(b"\r\n\r\n")[2])
    assert update.seen is None
    assert (first[1], second[1]) == (same.seen_bytes[0], 0)
    assert len(encode_update(update.model_copy(update={"seen": same.seen[0]}))) == len(encode_update(update)) + first[1]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        ({"voxels": [5, 6, 7]}, "or others"),
        ({"witnesses": [1, 1, 1, 1]}, "other witnesses"),
        ({"units_live": 1}, "expected 2 live units, got 1"),
        ({"complete": False, "reasons": ["the robot"]}, "the robot"),
    ],
)
async def test_a_wrong_map_is_reported(changes: dict[str, Any], words: str) -> None:
    units = [SimpleUnit("", View((b"",), (), ()), 0, b""), SimpleUnit("", View((b"",), (), ()), 0, b"")]
    units[0].keys, units[1].keys = np.array([5, 6, 7], "<u4").tobytes(), np.array([6, 9], "<u4").tobytes()
    right = {"voxels": [5, 6, 7, 9], "witnesses": [1, 2, 1, 1], "units_live": 2, "complete": True, "reasons": []}
    body = msgpack.packb({**right, **changes})
    async with fake_master(lambda number, request: (200, body)) as url:
        plan = Plan(url, "", str(DEMO_CELL), 2, 3, 1.0, 0.0)
        wrong = await asyncio.to_thread(map_is_right, plan, "token", units)
    assert words in wrong
    assert bool(wrong) == bool(words)


@pytest.mark.slow
def test_a_small_run_of_the_real_thing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = ["--units", "2", "--voxels", "100", "--seconds", "1", "--turns", "1"]
    master.main([*size, "--results", str(tmp_path)])
    document = json.loads(capsys.readouterr().out.splitlines()[-1])
    kept = json.loads((tmp_path / "master.json").read_text())
    assert kept.pop("taken")["load_average_before"] >= 0.0
    assert kept == document
    (load,) = document["loads"]
    assert (load["units"], load["voxels"], load["lost"], load["map_wrong"]) == (2, 100, 0, "")
    assert 400.0 < load["bytes_per_update"] <= 1200.0
    assert 0.0 < load["p50_ms"] <= load["p99_ms"] <= load["max_ms"]
    # Far below the mark, because other processes may be busy on the machine.
    assert document["max_updates_per_s"] > 300.0
    assert document["bare_fastapi_updates_per_s"] > 300.0
    assert Mark("", load["cpu_percent"], at_least=0.1).met


def test_the_load_uses_the_demo_cell() -> None:
    cell = Cell.load(DEMO_CELL)
    assert cell.lattice(0.05) == LATTICE
    assert cell.lattice(0.1) == BLOCKS
