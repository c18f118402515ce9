# SPDX-License-Identifier: Apache-2.0
"""A real unit with a RealSense camera that hangs, dies, is unplugged and is absent, as its master sees it."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from simulation.cameras.pluggable import plug
from tests.edge_unit.sources.realsense import recordings
from tests.system.cluster import Cluster, until, write_cell

NOTICED_S = 1.0
"""The master reports a camera failure within this time."""

POSE = {"xyz": [1.0, -1.0, 1.0], "rpy_deg": [-90.0, 0.0, 0.0]}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recordings.write(tmp_path_factory.mktemp("recordings") / "camera.db3", 45)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        cluster.start_master()
        yield cluster


def row(cluster: Cluster) -> dict[str, Any]:
    rows = cluster.get("/units")
    return rows[0] if rows else {"state": "", "reason": ""}


def until_row(cluster: Cluster, wanted: Callable[[dict[str, Any]], bool], what: str, timeout_s: float) -> float:
    """Return the seconds until the unit's row is as wanted."""
    began = time.monotonic()
    until(lambda: wanted(row(cluster)), what, timeout_s)
    return time.monotonic() - began


def capture_of(unit: subprocess.Popen[str]) -> psutil.Process:
    children = psutil.Process(unit.pid).children()
    return next(child for child in children if any("capture_process" in word for word in child.cmdline()))


def start_pluggable(cluster: Cluster, sockets: Path) -> subprocess.Popen[str]:
    unit = cluster.start_unit(1, {"kind": "realsense", "serial": "SYN0001"}, T_world_camera=POSE)
    unit.kill()
    unit.wait()
    # The same configuration, for a unit with other sockets.
    return cluster.start("pluggable", "tests.system.pluggable_unit", str(sockets), str(cluster.folder / "unit1.yaml"))


def test_a_hung_camera_is_known_within_a_second_and_a_killed_unit_leaves_nothing(
    cluster: Cluster, recording: Path
) -> None:
    source = {"kind": "realsense", "recording": str(recording), "loop": True}
    unit = cluster.start_unit(1, source, T_world_camera=POSE)
    cluster.until_live(1)
    first = row(cluster)["frame_number"]
    capture_of(unit).send_signal(signal.SIGSTOP)
    noticed_s = until_row(cluster, lambda it: it["state"] != "live", "notice", 5.0)
    assert noticed_s < NOTICED_S
    reason = row(cluster)["reason"]
    assert "camera silent" in reason or "capture hung" in reason
    until_row(cluster, lambda it: it["state"] == "live", "recovery", 10.0)
    assert row(cluster)["frame_number"] > first

    # Its shared memory has no name that could be left behind.
    assert "memfd:cellwatch-frames (deleted)" in Path(f"/proc/{unit.pid}/maps").read_text()
    capture = capture_of(unit)
    unit.kill()
    capture.wait(2.0)


def test_an_unplugged_camera_is_known_within_a_second_and_comes_back(
    cluster: Cluster, recording: Path, tmp_path: Path
) -> None:
    sockets = tmp_path / "sockets"
    plug(sockets, [recording])
    unit = start_pluggable(cluster, sockets)
    cluster.until_live(1)
    plug(sockets, [])
    assert until_row(cluster, lambda it: it["state"] != "live", "notice", 5.0) < NOTICED_S
    until_row(cluster, lambda it: "no RealSense camera SYN0001 is connected" in it["reason"], "the reason", 2.0)
    plug(sockets, [recording])
    until_row(cluster, lambda it: it["state"] == "live", "recovery", 10.0)

    # The unit starts without its camera, and the master still reports the missing serial.
    unit.kill()
    unit.wait()
    cluster.operator.delete(f"/units/{row(cluster)['id']}").raise_for_status()
    assert cluster.get("/units") == []
    plug(sockets, [])
    start_pluggable(cluster, sockets)
    until_row(cluster, lambda it: "no RealSense camera SYN0001 is connected" in it["reason"], "the missing one", 20.0)
    assert row(cluster)["serial"] == "SYN0001"
    plug(sockets, [recording])
    until_row(cluster, lambda it: it["state"] == "live", "the camera at last", 20.0)
