# SPDX-License-Identifier: Apache-2.0
"""Every program of examples/ runs, and says what its page says that it shows."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.system.cluster import Cluster

CHECKOUT = Path(__file__).resolve().parents[2]
EXAMPLES = CHECKOUT / "examples"
SECONDS = "1"
LIMIT_S = 500.0
"""Kernels may have to be compiled first."""


def run(program: str, *arguments: str) -> str:
    """Run an example, and return what it prints."""
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    command = [sys.executable, str(EXAMPLES / program), *arguments]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


@pytest.mark.slow
def test_one_frame_is_filtered() -> None:
    printed = run("filter_one_frame.py")
    found = re.search(r"^obstacle voxels: (\d+)$", printed, re.MULTILINE)
    assert found is not None, printed
    assert int(found[1]) > 0


@pytest.mark.slow
def test_a_background_is_learned_and_a_person_is_not_part_of_it() -> None:
    printed = run("learn_a_background.py")
    learned = re.search(r"^learned: (\d+)%", printed, re.MULTILINE)
    counts = [int(count) for count in re.findall(r": (\d+) obstacle voxels$", printed, re.MULTILINE)]
    assert learned is not None, printed
    assert int(learned[1]) > 90
    assert len(counts) == 2, printed
    assert counts[0] < counts[1] / 10


def test_a_cell_is_made_of_stl_files(tmp_path: Path) -> None:
    printed = run("cell_from_stl/make_stl.py", "--out", str(tmp_path))
    assert {file.name for file in tmp_path.iterdir()} == {"cell.yaml", "table.stl", "post.stl", "crate.stl"}
    assert "table: 12 triangles" in printed


def test_joints_reach_the_master_and_its_map_is_watched(master: Cluster) -> None:
    folder = master.folder / "master"
    fed = run(
        "feed_joints.py", "--url", master.url, "--token-file", str(folder / "operator.token"), "--seconds", SECONDS
    )
    sent = re.match(r"sent (\d+) samples", fed)
    assert sent is not None, fed
    assert int(sent[1]) > 10
    watched = run(
        "watch_the_map.py", "--url", master.url, "--token-file", str(folder / "unit.token"), "--seconds", SECONDS
    )
    assert watched.startswith("SLOW: the map is not complete"), watched


def test_the_page_names_every_example() -> None:
    page = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    programs = {f.name if f.is_file() else f"{f.name}/" for f in EXAMPLES.iterdir()} - {"README.md", "__pycache__/"}
    assert {name for name in programs if f"[{name}]" not in page} == set()
