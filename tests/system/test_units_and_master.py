# SPDX-License-Identifier: Apache-2.0
"""Real processes over HTTP: the map while units come, go, and change."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from edge_unit.monitoring import read_trace
from shared.lattice import Lattice
from tests.system.cluster import STOP_S, Cluster, stop, until, write_cell, write_recording

PERIOD_S = 1.0 / 15.0

# One camera beside the box looks along +y, the other along +x; the patch of each stands 0.5 m inside.
LOOKING_ALONG_Y = {"xyz": [1.0, -1.0, 1.0], "rpy_deg": [-90.0, 0.0, 0.0]}
LOOKING_ALONG_X = {"xyz": [-1.0, 1.0, 1.0], "rpy_deg": [-90.0, 0.0, -90.0]}


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        yield cluster


def source(cluster: Cluster, **more: Any) -> dict[str, Any]:
    folder = cluster.folder / "recording"
    if not folder.exists():
        write_recording(folder)
    return {"kind": "recorded", "folder": str(folder), "fps": 15.0, "loop": True, **more}


def start_two(cluster: Cluster) -> list[Any]:
    """Start a master and two live units that each see another patch."""
    cluster.start_master()
    first = cluster.start_unit(1, source(cluster, serial="ONE"), T_world_camera=LOOKING_ALONG_Y)
    second = cluster.start_unit(2, source(cluster, serial="TWO"), T_world_camera=LOOKING_ALONG_X)
    cluster.until_live(2)
    return [first, second]


def test_two_units_make_one_map_and_a_dead_one_is_missed(cluster: Cluster) -> None:
    first, _ = start_two(cluster)
    until(lambda: cluster.get("/voxels")["complete"], "a complete map", 5.0)
    view = cluster.get("/voxels?form=centres")
    lattice = Lattice(**view["lattice"])
    assert lattice.shape == (40, 40, 40)
    centres = {tuple(centre) for centre in view["voxels"]}
    of_first = {centre for centre in centres if abs(centre[1] - 0.5) < 0.06 and abs(centre[0] - 1.0) < 0.3}
    of_second = {centre for centre in centres if abs(centre[0] - 0.5) < 0.06 and abs(centre[1] - 1.0) < 0.3}
    assert len(of_first) >= 80
    assert len(of_second) >= 80
    assert of_first | of_second == centres
    assert view["oldest_view_age_s"] < 0.5
    unseen = cluster.get("/voxels?unseen=true")["unseen"]
    assert 0 < len(unseen["blocks"]) < 20**3

    killed_at = time.monotonic()
    first.kill()
    view = until(lambda: (now := cluster.get("/voxels?form=centres"))["complete"] is False and now, "noticed", 5.0)
    # One additional request, because this process polls on a busy machine.
    assert time.monotonic() - killed_at < 0.5 + PERIOD_S + 0.2
    assert {tuple(centre) for centre in view["voxels"]} == of_second
    assert view["units_live"] == 1
    assert "127.0.0.2) is stale" in view["reasons"][0]
    assert len(cluster.get("/voxels?unseen=true")["unseen"]["blocks"]) > len(unseen["blocks"])

    cluster.start_unit(1, source(cluster, serial="ONE"))
    # Without a pose in its configuration: the master has kept it.
    cluster.until_live(2)
    until(lambda: cluster.get("/voxels")["complete"], "a complete map again", 5.0)


def test_a_new_voxel_size_reaches_all_units_while_they_run(cluster: Cluster) -> None:
    units = start_two(cluster)
    before = until(lambda: (view := cluster.get("/voxels"))["complete"] and view, "a complete map", 5.0)
    assert cluster.put("/settings", {"voxel_size_m": 0.1})["voxel_size_m"] == 0.1
    after = until(lambda: (view := cluster.get("/voxels"))["complete"] and view, "a complete map", 5.0)
    assert after["lattice"]["voxel_size_m"] == 0.1
    assert after["lattice_version"] == before["lattice_version"] + 1
    assert 40 <= len(after["voxels"]) < len(before["voxels"])
    assert max(max(index) for index in after["voxels"]) < 20
    assert all(unit.poll() is None for unit in units)
    refused = cluster.operator.put("/settings", json={"voxel_size_m": 1.0})
    assert refused.status_code == 422
    assert "voxel_size_m" in refused.json()["detail"]


def test_units_find_a_restarted_master(cluster: Cluster) -> None:
    master = cluster.start_master()
    cluster.start_unit(1, source(cluster), T_world_camera=LOOKING_ALONG_Y)
    cluster.until_live(1)
    master.kill()
    master.wait()
    (cluster.folder / "ready.json").unlink()
    cluster.start_master()
    cluster.until_live(1, 2.0)
    assert len(cluster.get("/voxels")["voxels"]) >= 80


def test_a_wrong_token_is_refused_until_it_is_right(cluster: Cluster) -> None:
    cluster.start_master()
    token_file = cluster.folder / "token"
    token_file.write_text("not-the-token-of-this-master")
    unit = cluster.start_unit(1, source(cluster), T_world_camera=LOOKING_ALONG_Y, token_file=str(token_file))
    until(lambda: "401: unknown token" in cluster.log("unit1"), "the refusal in the log")
    assert cluster.get("/units") == []
    assert "not-the-token" not in cluster.log("unit1") + cluster.log("master")
    token_file.write_text(Path(cluster.unit_token_file).read_text())
    cluster.until_live(1, 5.0)
    assert unit.poll() is None


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_both_stop_at_once_on_a_signal(cluster: Cluster, number: signal.Signals) -> None:
    master = cluster.start_master()
    unit = cluster.start_unit(1, source(cluster), T_world_camera=LOOKING_ALONG_Y)
    cluster.until_live(1)
    assert stop(unit, number) < STOP_S
    assert unit.returncode == 0
    assert stop(master, number) < STOP_S
    assert master.returncode == 0
    assert not (cluster.folder / "ready.json").exists()
    assert "Traceback" not in cluster.log("master") + cluster.log("unit1")


def test_a_recording_that_ends_has_all_its_frames_merged(cluster: Cluster) -> None:
    cluster.start_master()
    trace = cluster.folder / "trace"
    frames = [0] * 20
    unit = cluster.start_unit(
        1, source(cluster, loop=False, frames=frames), T_world_camera=LOOKING_ALONG_Y, trace_path=str(trace)
    )
    until(lambda: unit.poll() is not None, "the end")
    assert unit.returncode == 0
    records = read_trace(trace)
    assert [record.frame_number for record in records] == list(range(20))
    assert all(record.sent and record.merged_at_ns is not None for record in records)
    assert all(len(record.keys) >= 4 * 80 for record in records)


def test_background_is_learned_on_request_and_dropped_again(cluster: Cluster) -> None:
    cluster.start_master()
    # Quicker than the others, for many frames are learned.
    quick = source(cluster, fps=60.0)
    cluster.start_unit(1, quick, T_world_camera=LOOKING_ALONG_Y, learn_background_frames=0)
    cluster.until_live(1)
    unit_id = cluster.get("/units")[0]["id"]
    assert cluster.operator.post(f"/units/{unit_id}/background").status_code == 202
    # Everything static is background from now on.
    until(lambda: cluster.states() == {"127.0.0.2": "live"} and cluster.get("/voxels")["voxels"] == [], "learned", 20.0)
    assert cluster.operator.delete(f"/units/{unit_id}/background").status_code == 202
    until(lambda: len(cluster.get("/voxels")["voxels"]) >= 80, "dropped", 5.0)


@pytest.mark.patient
@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"source": {"kind": "recorded", "folder": "gone"}}, "gone: expected the folder of a recording"),
        ({"source": {"kind": "camera"}}, "source"),
        ({"token_file": "gone.token"}, "gone.token"),
        ({"fsp_max": 3}, "fsp_max"),
    ],
)
def test_a_unit_that_cannot_start_prints_the_reason_in_one_line(
    cluster: Cluster, config: dict[str, Any], words: str
) -> None:
    token_file = cluster.folder / "token"
    token_file.write_text("some-token-0123456789")
    unit = cluster.start_unit(1, **{"source": source(cluster), "token_file": str(token_file), **config})
    unit.wait(30.0)
    assert unit.returncode == 1
    last = cluster.log("unit1").splitlines()[-1]
    assert last.startswith("edge-unit: ")
    assert words in last
    assert "Traceback" not in cluster.log("unit1")
