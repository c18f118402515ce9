# SPDX-License-Identifier: Apache-2.0
"""A real master with misbehaving peers, while one unit works on."""

from __future__ import annotations

import asyncio
import json
import subprocess
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from benchmarks.load_generator.load import Plan
from tests.system.bad_peers import BadPeers
from tests.system.cluster import Cluster, write_cell

SECONDS, WARM_UP_S = 6.0, 1.0
"""Longer than the timeout of a request's head, so that slow senders are dropped and reconnect meanwhile."""

RATE_HZ = 30.0
VOXELS = 500
P99_MS_MAX = 100.0
"""Round trip of a unit's update with all peers, on a machine of two cores that runs the peers, too."""

GROWTH_MAX_BYTES = 64 * 2**20
"""512 connections with the data of each, and bodies of 1 MiB in flight. Without bounds memory grows by as much every
second.
"""

LOG_MAX_BYTES = 200_000


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        cluster.start_master()
        yield cluster


def begin_unit(cluster: Cluster, name: str) -> subprocess.Popen[str]:
    plan = Plan(
        cluster.url, cluster.unit_token_file, str(cluster.cell), 1, VOXELS, SECONDS, WARM_UP_S, RATE_HZ,
        cluster.processes[0].pid,
    )  # fmt: skip
    path = cluster.folder / f"{name}.plan.json"
    path.write_text(json.dumps(asdict(plan)))
    return cluster.start(name, "benchmarks.load_generator.load", str(path), str(cluster.folder / f"{name}.json"))


def result(cluster: Cluster, name: str, process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.wait(10 * SECONDS) == 0, cluster.log(name)
    found: dict[str, Any] = json.loads((cluster.folder / f"{name}.json").read_text())
    assert (found["lost"], found["trouble"], found["map_wrong"]) == (0, "", "")
    assert found["sent"] == round((SECONDS + WARM_UP_S) * RATE_HZ)
    return found


@pytest.mark.slow
async def test_bad_peers_cost_a_unit_no_update(cluster: Cluster) -> None:
    alone = await asyncio.to_thread(result, cluster, "alone", begin_unit(cluster, "alone"))
    master = psutil.Process(cluster.processes[0].pid)
    (row,) = cluster.get("/units")
    before = master.memory_info().rss
    most = before
    token = Path(cluster.unit_token_file).read_text().strip()
    async with BadPeers(httpx.URL(cluster.url).port or 0, token, row["id"]) as peers:
        unit = begin_unit(cluster, "among")
        while unit.poll() is None:
            most = max(most, master.memory_info().rss)
            await asyncio.sleep(0.1)
        # The address is the operator's, not that of a peer.
        assert (await asyncio.to_thread(cluster.get, "/healthz"))["status"] == "ok"
    among = result(cluster, "among", unit)
    grown = most - before
    log_bytes = len(cluster.log("master"))
    told = ", ".join(
        f"{name} {found['p99_ms']:.1f} ms" for name, found in (("alone", alone), ("among bad peers", among))
    )
    print(f"p99 of a unit's updates: {told}; master {grown / 2**20:.1f} MiB more, log {log_bytes} bytes; {peers.seen}")
    assert among["p99_ms"] < max(P99_MS_MAX, 10 * alone["p99_ms"])
    assert grown < GROWTH_MAX_BYTES
    assert log_bytes < LOG_MAX_BYTES
    # All peers misbehaved, and the master took nothing of it.
    assert all(peers.seen[kind] for kind in ("slow_head", "slow_body", "garbage", "flood", "403"))
    assert not peers.seen["200"]
