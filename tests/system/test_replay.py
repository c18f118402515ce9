# SPDX-License-Identifier: Apache-2.0
"""Real processes: a master records for five seconds and is stopped or killed; then its recording is served."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import connect

from tests.system.cluster import START_S, STOP_S, Cluster, stop, until, write_cell, write_recording

LOOKING_ALONG_Y = {"xyz": [1.0, -1.0, 1.0], "rpy_deg": [-90.0, 0.0, 0.0]}
SECONDS = 5.0


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        yield cluster


def start_replay(cluster: Cluster, file: str, *options: str) -> subprocess.Popen[str]:
    """Serve a recording at the master's port, with its tokens."""
    ready = cluster.folder / "ready.json"
    ready.unlink(missing_ok=True)
    process = cluster.start(
        "replay", "master_server", "replay", file, "--host", "127.0.0.1", "--port", str(cluster.port),
        "--state-dir", str(cluster.folder / "master"), "--ready-file", str(ready), *options,
    )  # fmt: skip

    def look() -> bool:
        assert process.poll() is None, cluster.log("replay")
        return ready.exists()

    until(look, "the replay")
    return process


def comparable(voxels: dict[str, Any]) -> dict[str, Any]:
    """Return the parts that are the same at any time: ages change, a patch does not."""
    return {
        key: voxels[key] for key in ("lattice", "voxels", "witnesses", "complete", "reasons", "units_live", "unseen")
    }


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_recording_is_served_again(cluster: Cluster, number: signal.Signals) -> None:
    folder = cluster.folder / "recordings"
    master = cluster.start_master("--record", str(folder))
    source = {"kind": "recorded", "folder": str(write_recording(cluster.folder / "images")), "fps": 15.0, "loop": True}
    cluster.start_unit(1, source, T_world_camera=LOOKING_ALONG_Y)
    cluster.until_live(1, 2 * START_S)
    until(lambda: len(cluster.get("/voxels")["voxels"]) >= 80, "the patch")
    seen_live = cluster.get("/recording")["moments"]
    until(lambda: cluster.get("/recording")["moments"] >= seen_live + SECONDS * 10, "five seconds", 3 * SECONDS)
    status = cluster.get("/recording")
    assert (status["recording"], status["dropped"], status["reason"]) == (True, 0, "")
    then = comparable(cluster.get("/voxels?unseen=true"))
    cell, settings, units = cluster.get("/cell"), cluster.get("/settings"), cluster.get("/units")
    took_s = stop(master, number)
    if number is signal.SIGTERM:
        assert took_s < STOP_S
        assert master.returncode == 0

    replay = start_replay(cluster, status["file"], "--speed", "2")
    assert cluster.get("/healthz") == {"status": "ok", "replay": True}
    stands = cluster.get("/replay")
    assert stands["playing"]
    assert stands["speed"] == 2.0
    assert stands["duration_s"] >= SECONDS - 1.0
    # A moment before the end, because the last frame may be that of a stopped unit.
    cluster.put("/replay", {"position_s": stands["duration_s"] - 1.0, "playing": False})
    assert comparable(cluster.get("/voxels?unseen=true")) == then
    assert cluster.get("/cell") == cell
    assert cluster.get("/settings") == settings
    (row,) = cluster.get("/units")
    assert {key: row[key] for key in ("id", "ip", "serial", "state", "T_world_camera")} == {
        key: units[0][key] for key in ("id", "ip", "serial", "state", "T_world_camera")
    }
    # A running unit is refused with a reason, and nothing of it is stored.
    assert cluster.operator.put("/settings", json={"voxel_size_m": 0.03}).status_code == 409

    cluster.put("/replay", {"position_s": stands["duration_s"] - 3.0, "playing": True})
    messages = asyncio.run(heard(cluster, 8))
    assert len({json.dumps(message["units"]) for message in messages}) > 1
    info = subprocess.run(
        [sys.executable, "-m", "master_server", "recording-info", status["file"]],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "cell      bench: 0 0 0 to 2 2 2 m" in info
    killed = number is signal.SIGKILL
    assert ("its writer was stopped before it could finish it" in info) is killed
    assert stop(replay, signal.SIGTERM) < STOP_S
    assert replay.returncode == 0
    assert "Traceback" not in cluster.log("master") + cluster.log("replay")


async def heard(cluster: Cluster, count: int) -> list[Any]:
    """Return that many messages of the stream."""
    url = f"{cluster.url.replace('http', 'ws', 1)}/stream?encoding=json"
    headers = {"Authorization": cluster.operator.headers["Authorization"]}
    async with connect(url, additional_headers=headers) as socket:
        assert socket.response is not None
        assert socket.response.headers["cellwatch-replay"] == "true"
        return [json.loads(await socket.recv()) for _ in range(count)]
