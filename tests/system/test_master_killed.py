# SPDX-License-Identifier: Apache-2.0
"""A master, and processes that write to its store, killed during a write: acknowledged data is present and whole."""

from __future__ import annotations

import asyncio
import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from master_server.persistence import Store
from master_server.persistence.store import FILE_NAME
from shared.clock import monotonic_ns
from shared.messages import InitializeAnswer
from shared.waiting import within
from shared.wire import MEDIA_TYPE, decode, encode
from tests.master_server.fakes import AT_ORIGIN, FakeUnit, master
from tests.system.cluster import CELL, START_S, Cluster

KILLS = 100

MASTER_KILLS = 10
STEP = 0.001
"""Time between two written values."""
STAY = 3
"""Number of the newest units, which are not deleted yet."""

WRITER = """
import sys, threading
from pathlib import Path
from master_server.persistence.store import Store, UnitRecord
from shared.messages import Versions
from shared.settings import Settings

store = Store.open(Path(sys.argv[1]))
begin = int(sys.argv[2])

def units(number):
    for version in range(begin + 1, begin + 10**6):
        pose = tuple(tuple(float(version) for _ in range(4)) for _ in range(4))
        record = UnitRecord(id=number, ip=f"10.0.0.{number}", T_world_camera=pose, pose_version=version)
        store.save_units([record])
        print(f"unit {number} {version}", flush=True)

def settings():
    for version in range(begin + 1, begin + 10**6):
        size_m = 0.01 + version % 1000 * 1e-5
        store.save_settings(Settings(voxel_size_m=size_m), Versions(settings=version))
        print(f"settings 0 {version}", flush=True)

threads = [threading.Thread(target=units, args=(number,), daemon=True) for number in (1, 2)]
threads.append(threading.Thread(target=settings, daemon=True))
for thread in threads: thread.start()
for thread in threads: thread.join()
"""


@pytest.mark.slow
def test_acknowledged_writes_of_a_killed_process_are_stored_whole(tmp_path: Path) -> None:
    """Kill (SIGKILL) a child that holds the store alone and has three writers. The master itself is not in it."""
    path = tmp_path / FILE_NAME
    dice = random.Random(1)
    highest = 0
    acknowledged: dict[str, int] = {}
    for _ in range(KILLS):
        child = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path), str(highest)], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        lines = [child.stdout.readline()]
        time.sleep(dice.uniform(0.0, 0.05))  # The moment of the kill, anywhere in a write.
        child.send_signal(signal.SIGKILL)
        lines += child.stdout.read().splitlines()
        child.stdout.close()
        child.wait()
        for line in lines:
            fields = line.split()
            if len(fields) == 3:
                acknowledged[f"{fields[0]} {fields[1]}"] = int(fields[2])
        store = Store.open(path)
        saved = store.load()
        store.close()
        stored = {f"unit {unit.id}": unit.pose_version for unit in saved.units}
        for unit in saved.units:
            assert unit.T_world_camera == ((float(unit.pose_version),) * 4,) * 4
        if saved.versions is not None:
            stored["settings 0"] = saved.versions.settings
            assert saved.settings["voxel_size_m"] == 0.01 + saved.versions.settings % 1000 * 1e-5
        # One write may have finished without its acknowledgement.
        for name, version in acknowledged.items():
            assert version <= stored[name] <= max(version, highest) + 1
        highest = max(stored.values())
    assert highest > KILLS


@dataclass
class Ledger:
    """Acknowledgements of one master to writers that each wait for their answer. The next write may be stored, too."""

    units: dict[str, int] = field(default_factory=dict)
    poses: dict[int, int] = field(default_factory=dict)
    settings: int = 0
    object: int = 0
    joins: int = 0
    last_id: int = 0
    unsure: set[str] = field(default_factory=set)
    heard: set[str] = field(default_factory=set)
    count: int = 0

    def hear(self, what: str) -> None:
        """Record an answer."""
        self.heard.add(what)
        self.count += 1


def at(step: int) -> list[list[float]]:
    return [[1.0, 0.0, 0.0, step * STEP], *(list(row) for row in AT_ORIGIN[1:])]


class Writers:
    """All writers to one master, in parallel and each from an address of its own, until the master is gone."""

    def __init__(self, cluster: Cluster, ledger: Ledger) -> None:
        self._cluster = cluster
        self._ledger = ledger
        self._operator = {"Authorization": cluster.operator.headers["Authorization"]}
        token = Path(cluster.unit_token_file).read_text().strip()
        self._unit = {"Authorization": f"Bearer {token}", "Content-Type": MEDIA_TYPE, "Accept": MEDIA_TYPE}

    def client(self, ip: str, headers: dict[str, str]) -> httpx.AsyncClient:
        transport = httpx.AsyncHTTPTransport(local_address=ip)
        return httpx.AsyncClient(base_url=self._cluster.url, headers=headers, transport=transport)

    async def join(self, ip: str) -> int:
        """Register a unit and return its id."""
        introduction = FakeUnit(master(), ip, f"S{ip}").introduction(monotonic_ns())
        async with self.client(ip, self._unit) as client:
            response = await client.post("/initialize", content=encode(introduction))
        assert response.status_code == 200, response.text
        return decode(InitializeAnswer, response.content).id

    async def pose(self, number: int) -> None:
        ledger = self._ledger
        async with self.client(f"127.0.1.{number}", self._operator) as client:
            while True:
                step = ledger.poses[number] + 1
                response = await client.put(f"/units/{number}/pose", json={"T_world_camera": at(step)})
                assert response.status_code == 200, response.text
                ledger.poses[number] = step
                ledger.hear(f"pose {number}")

    async def settings(self) -> None:
        async with self.client("127.0.1.100", self._operator) as client:
            while True:
                step = self._ledger.settings + 1
                response = await client.put("/settings", json={"stale_after_s": 1.0 + step * STEP})
                assert response.status_code == 200, response.text
                self._ledger.settings = step
                self._ledger.hear("settings")

    async def object(self) -> None:
        async with self.client("127.0.1.101", self._operator) as client:
            while True:
                step = self._ledger.object + 1
                response = await client.put("/cell/objects/box/pose", json={"T_world_object": at(step)})
                assert response.status_code == 200, response.text
                self._ledger.object = step
                self._ledger.hear("object")

    async def come_and_go(self) -> None:
        ledger = self._ledger
        async with self.client("127.0.1.102", self._operator) as client:
            while True:
                ledger.joins += 1
                ip = f"127.0.{2 + ledger.joins // 250}.{1 + ledger.joins % 250}"
                ledger.unsure = {ip}
                number = await self.join(ip)
                assert number > ledger.last_id
                ledger.last_id = number
                ledger.units[ip] = number
                ledger.hear("join")
                while len(ledger.units) > STAY:
                    oldest = next(iter(ledger.units))
                    ledger.unsure = {oldest}
                    response = await client.delete(f"/units/{ledger.units[oldest]}")
                    assert response.status_code == 204, response.text
                    del ledger.units[oldest]
                    ledger.hear("delete")
                ledger.unsure = set()

    async def write_until(self, kill: Callable[[], None], wait_s: float) -> None:
        """Write. Once every writer has an answer, call `kill` after `wait_s`."""
        works = [self.pose(number) for number in self._ledger.poses]
        works += [self.settings(), self.object(), self.come_and_go()]
        kinds = len(works) + 1
        self._ledger.heard.clear()

        async def until_all_were_heard() -> None:
            while len(self._ledger.heard) < kinds:
                assert not any(task.done() for task in tasks), await asyncio.gather(*tasks, return_exceptions=True)
                await asyncio.sleep(0.002)

        tasks = [asyncio.ensure_future(_until_gone(work)) for work in works]
        assert await within(START_S, until_all_were_heard())
        await asyncio.sleep(wait_s)  # The moment of the kill, anywhere in a write.
        kill()
        await asyncio.gather(*tasks)


async def _until_gone(work: Coroutine[Any, Any, None]) -> None:
    try:
        await work
    except httpx.TransportError:
        return


def check(cluster: Cluster, ledger: Ledger) -> None:
    """Check that all acknowledged data is present. Data in flight is accepted as it is."""
    rows = {row["ip"]: row for row in cluster.get("/units")}
    by_id = {row["id"]: row for row in rows.values()}
    for number, step in ledger.poses.items():
        found = round(by_id[number]["T_world_camera"][0][3] / STEP)
        assert found in (step, step + 1)
        assert by_id[number]["T_world_camera"] == at(found)
        ledger.poses[number] = found
    found = round((cluster.get("/settings")["stale_after_s"] - 1.0) / STEP)
    assert found in (ledger.settings, ledger.settings + 1)
    ledger.settings = found
    (box,) = cluster.get("/cell")["objects"]
    found = round(box["T_world_mesh"][0][3] / STEP)
    assert found in (ledger.object, ledger.object + 1)
    ledger.object = found
    passers = {ip: row["id"] for ip, row in rows.items() if row["id"] not in ledger.poses}
    for ip in passers.keys() | ledger.units.keys():
        if ip not in ledger.unsure:
            assert passers.get(ip) == ledger.units.get(ip), ip
    ledger.units = dict(sorted(passers.items(), key=lambda item: item[1]))
    ledger.last_id = max(ledger.last_id, *passers.values())


@pytest.mark.slow
async def test_acknowledged_changes_of_a_killed_master_survive(tmp_path: Path) -> None:
    dice = random.Random(2)
    box = {"name": "box", "box": [0.2, 0.2, 0.2]}
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump({**CELL, "objects": [box]}))
    with Cluster(tmp_path, path) as cluster:
        process = await asyncio.to_thread(cluster.start_master)
        ledger = Ledger()
        for number in (1, 2):
            ledger.last_id = await Writers(cluster, ledger).join(f"127.0.1.{number}")
            assert ledger.last_id == number
            ledger.poses[number] = 0
            cluster.put(f"/units/{number}/pose", {"T_world_camera": at(0)})
        for _ in range(MASTER_KILLS):
            await Writers(cluster, ledger).write_until(process.kill, dice.uniform(0.0, 0.1))
            process.wait()
            (tmp_path / "ready.json").unlink()
            process = await asyncio.to_thread(cluster.start_master)
            check(cluster, ledger)
        assert ledger.count > 10 * MASTER_KILLS
        print(json.dumps({"acknowledged": ledger.count, "joins": ledger.joins}))
