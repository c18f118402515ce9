# SPDX-License-Identifier: Apache-2.0
"""A real master and a real unit whose token is replaced while both run."""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import httpx
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from tests.system.cluster import Cluster, until, write_cell
from tests.system.test_units_and_master import LOOKING_ALONG_Y, source

COUNTS_WITHIN_S = 1.0


def replace(cluster: Cluster, role: str) -> str:
    """Replace a token on the command line and return the new one."""
    state_dir = Path(cluster.unit_token_file).parent
    command = (sys.executable, "-m", "master_server", "new-token", role, "--state-dir", str(state_dir))
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    token = (state_dir / f"{role}.token").read_text().strip()
    assert token not in printed
    return token


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def listen(cluster: Cluster, token: str) -> ClientConnection:
    reader = connect(
        cluster.url.replace("http", "ws") + "/stream", additional_headers=bearer(token), proxy=None, compression=None
    )
    reader.recv(timeout=5.0)
    return reader


def closed_with(reader: ClientConnection) -> int | None:
    """Read to the end, and return the close code of the master."""
    with suppress(ConnectionClosed):
        while True:
            reader.recv(timeout=COUNTS_WITHIN_S)
    return reader.close_code


def test_the_units_token_is_replaced_while_all_runs(tmp_path: Path) -> None:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        cluster.start_master()
        old = Path(cluster.unit_token_file).read_text().strip()
        own = tmp_path / "own.token"
        own.write_text(old)
        unit = cluster.start_unit(1, source(cluster), T_world_camera=LOOKING_ALONG_Y, token_file=str(own))
        cluster.until_live(1)
        until(lambda: cluster.get("/voxels")["complete"], "a complete map", 5.0)
        (before,) = cluster.get("/units")
        with listen(cluster, old) as reader:
            new = replace(cluster, "unit")
            replaced_at = time.monotonic()
            assert closed_with(reader) == 1008
            assert time.monotonic() - replaced_at < COUNTS_WITHIN_S
        assert httpx.get(cluster.url + "/units", headers=bearer(old)).status_code == 401
        assert httpx.get(cluster.url + "/units", headers=bearer(new)).status_code == 200
        until(lambda: "401: unknown token" in cluster.log("unit1"), "the refusal in the unit's log", 5.0)
        until(lambda: not cluster.get("/voxels")["complete"], "that the unit is missed", 5.0)
        # The unit retries with its token, and reads the file again each time.
        own.write_text(new + "\n")
        put_at = time.monotonic()
        cluster.until_live(1, 5.0)
        until(lambda: cluster.get("/voxels")["complete"], "a complete map again", 5.0)
        assert time.monotonic() - put_at < 2.0
        assert unit.poll() is None
        (after,) = cluster.get("/units")
        assert (after["id"], after["T_world_camera"]) == (before["id"], before["T_world_camera"])
        logs = cluster.log("unit1") + cluster.log("master")
        assert "unit.token was replaced" in logs
        assert old not in logs
        assert new not in logs


def test_the_operators_token_is_replaced_and_a_damaged_file_keeps_the_old_one(tmp_path: Path) -> None:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        master = cluster.start_master()
        file = Path(cluster.unit_token_file).with_name("operator.token")
        old = file.read_text().strip()
        file.write_text("")
        until(lambda: "the old token stays valid" in cluster.log("master"), "the warning", 5.0)
        assert cluster.put("/settings", {"voxel_size_m": 0.1})
        file.unlink()
        until(lambda: "No such file" in cluster.log("master"), "the other warning", 5.0)
        assert cluster.put("/settings", {"voxel_size_m": 0.05})
        with listen(cluster, old) as reader:
            new = replace(cluster, "operator")
            assert closed_with(reader) == 1008
        assert cluster.operator.put("/settings", json={"voxel_size_m": 0.1}).status_code == 401
        cluster.operator.headers.update(bearer(new))
        assert cluster.put("/settings", {"voxel_size_m": 0.1})
        # The next master starts with the stored state.
        master.kill()
        master.wait()
        (tmp_path / "ready.json").unlink()
        cluster.start_master()
        assert httpx.get(cluster.url + "/units", headers=bearer(new)).status_code == 200
        assert httpx.get(cluster.url + "/units", headers=bearer(old)).status_code == 401
