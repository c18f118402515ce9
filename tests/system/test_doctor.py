# SPDX-License-Identifier: Apache-2.0
"""`edge-unit doctor` with a real master."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.edge_unit.sources.realsense import recordings
from tests.system.cluster import Cluster, write_cell


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        cluster.start_master()
        yield cluster


def doctor(config: Path, *options: str) -> tuple[int, dict[str, str]]:
    """Return the exit code, and the level of each finding."""
    command = [sys.executable, "-m", "edge_unit", "doctor", str(config), "--seconds", "1", *options]
    ended = subprocess.run(command, capture_output=True, text=True)
    lines = [line.split(maxsplit=2) for line in ended.stdout.splitlines()]
    assert lines, ended.stderr
    return ended.returncode, {what: level for level, what, _ in lines}


def test_all_is_well_and_the_master_is_not_changed(cluster: Cluster) -> None:
    recording = recordings.write(cluster.folder / "camera.db3", 30)
    config = cluster.folder / "unit.yaml"
    source = {"kind": "realsense", "recording": str(recording), "loop": True}
    config.write_text(
        yaml.safe_dump({"source": source, "master_url": cluster.url, "token_file": cluster.unit_token_file})
    )
    status, levels = doctor(config)
    levels.pop("clock")
    assert status == 0
    found = ("software", "network", "master", "token", "cell")
    expected = (*found, "sdk", "camera", "stream", "depth", "kernels", "pipeline")
    assert levels == dict.fromkeys(expected, "ok")
    assert cluster.get("/units") == []

    status, levels = doctor(config, "--set", "token_file=null", "--set", "token=wrong")
    assert status == 1
    assert levels["token"] == "FAIL"
