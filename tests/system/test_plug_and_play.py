# SPDX-License-Identifier: Apache-2.0
"""`make plug-and-play`, through the same code: four units that know nothing but a token."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from qualification.plug_and_play import FIRST_VOXEL_S_MAX, NOTICE_S_MAX, POSE_DEG_MAX, POSE_MM_MAX, ROBOT_PERCENT_MAX
from tests.missing import need_namespaces

pytestmark = pytest.mark.slow

BUSY_S = 1.0
"""Time that other tests beside may add to one that is not bound by computing."""

BUSY_START = 5.0
"""A start is mostly computing; beside other tests it takes so many times as long."""


@pytest.fixture(scope="module")
def played() -> dict[str, Any]:
    need_namespaces()
    command = (sys.executable, "-m", "qualification.plug_and_play", "--quiet-seconds", "6")
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.stdout, run.stderr
    return dict(json.loads(run.stdout.splitlines()[-1]))


def test_units_that_know_nothing_are_live_and_no_file_is_edited(played: dict[str, Any]) -> None:
    assert played["units_live"] == 4
    assert played["files_edited"] == 0
    assert played["seconds_to_first_voxel_max"] <= FIRST_VOXEL_S_MAX * BUSY_START, played["seconds_to_first_voxel"]


def test_they_find_where_their_cameras_hang(played: dict[str, Any]) -> None:
    assert len(played["poses"]) == 5
    assert played["pose_error_mm_max"] <= POSE_MM_MAX, played["poses"]
    assert played["pose_error_deg_max"] <= POSE_DEG_MAX, played["poses"]


def test_another_address_is_the_same_unit(played: dict[str, Any]) -> None:
    found = played["another_address"]
    assert found["same_camera"]
    assert found["same_pose"]
    assert found["old_slot_retired"]


def test_another_camera_has_no_pose_until_it_finds_its_own(played: dict[str, Any]) -> None:
    found = played["another_camera"]
    assert found["pose_void"]
    assert found["same_unit"]


@pytest.mark.parametrize("what", ["knocked", "covered"])
def test_a_worthless_view_is_reported_and_does_not_count(played: dict[str, Any], what: str) -> None:
    found = played[what]
    assert found["seconds_to_notice"] <= NOTICE_S_MAX + BUSY_S
    before, meanwhile = found["seen_share"]
    assert meanwhile < before
    assert found["seconds_to_recover"] <= NOTICE_S_MAX + BUSY_S


def test_the_robot_is_no_obstacle(played: dict[str, Any]) -> None:
    assert played["robot_frames_percent"] <= ROBOT_PERCENT_MAX, played["frames"]
    assert all(frames["judged"] > 50 for frames in played["frames"].values())
