# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from shared.errors import MasterUnreachable
from simulation.fleet.processes import ChildNotReady, Processes, until_written
from simulation.fleet.running_master import start_master
from simulation.world.world import DEMO_CELL

LONG_S = 60.0


async def test_a_master_that_was_started_can_be_asked_with_its_own_token(tmp_path: Path) -> None:
    async with Processes(tmp_path / "logs") as processes:
        master = await start_master(processes, DEMO_CELL, tmp_path / "master", "--set", "viewer=false", ready_s=LONG_S)
        assert master.pid == master.child.pid
        assert master.url.endswith(f":{master.port}")
        async with httpx.AsyncClient(base_url=master.url, headers=master.as_operator, trust_env=False) as client:
            assert (await client.get("/settings")).status_code == 200
            assert (await client.put("/settings", json={})).status_code == 200
        headers = {"Authorization": f"Bearer {master.unit_token}"}
        async with httpx.AsyncClient(base_url=master.url, headers=headers, trust_env=False) as client:
            assert (await client.put("/settings", json={})).status_code == 403


async def test_a_master_that_ends_instead_is_told_with_the_end_of_its_log(tmp_path: Path) -> None:
    async with Processes(tmp_path / "logs") as processes:
        with pytest.raises(MasterUnreachable, match=r"master: exit code \d+; the end of its log:\n.*nowhere\.yaml"):
            await start_master(processes, tmp_path / "nowhere.yaml", tmp_path / "master", ready_s=LONG_S)
        assert [child.failed for child in processes] == [False]


async def test_a_child_that_writes_nothing_is_waited_for_only_so_long(tmp_path: Path) -> None:
    async with Processes(tmp_path / "logs") as processes:
        child = await processes.start("server", "http.server", "--bind", "127.0.0.1", "0")
        with pytest.raises(ChildNotReady, match=r"server: not ready within 0\.1 s; "):
            await until_written(child, tmp_path / "never", 0.1)
        (tmp_path / "written").write_bytes(b"all of it")
        assert await until_written(child, tmp_path / "written", 0.1) == b"all of it"
