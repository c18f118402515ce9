# SPDX-License-Identifier: Apache-2.0
"""The handling of a live camera, on the SDK's software device (see `live_camera`)."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from tests.edge_unit.sources.realsense import recordings


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return the results of the process; skips if the SDK cannot be imported."""
    recordings.write(tmp_path_factory.mktemp("probe") / "probe.db3", 1)
    command = (sys.executable, "-m", "tests.edge_unit.sources.realsense.live_camera")
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def test_the_profile_falls_back_to_the_ports_limit(told: Any) -> None:
    streams = told["streams"]
    assert streams["profile"] == [640, 480, 15]
    assert streams["warning"] == (
        "the camera is at a USB 2.1 port or cable; use a USB 3 port and its cable; "
        "848x480 at 15 fps is not offered, running 640x480 at 15 fps"
    )
    assert streams["baseline_m"] == 0.0
    assert streams["color"] == "camera LIVE1 offers no color stream (rgb8)"


def test_the_emitter_is_off_only_for_images_of_the_board(told: Any) -> None:
    emitter, global_time = zip(
        *(told["streams"][when] for when in ("before", "depth_options", "infrared_options", "options_afterwards")),
        strict=True,
    )
    assert emitter == (0.0, 1.0, 0.0, 1.0)
    assert told["streams"]["infrared_width"] == 640
    # Time stamps are to be the camera's own.
    assert global_time[1] == 0.0


def test_no_frame_is_read_twice_and_its_time_is_that_of_the_exposure(told: Any) -> None:
    readings = told["streams"]["readings"]
    assert [(number, pixel) for number, pixel, _ in readings] == [(1, 1), (2, 2), (5, 5)]
    # The assumed time from read-out to arrival is 20 ms; the reported one from exposure to read-out is 4 ms.
    for _, _, age_ms in readings:
        assert 18.0 < age_ms <= 24.0
    assert told["streams"]["silent"]


def test_a_camera_in_use_is_distinguished_from_one_that_fails(told: Any) -> None:
    busy, other = told["busy"].values()
    assert "camera LIVE1 is in use by another program" in busy
    assert "stop that one" in busy
    assert other == "camera LIVE1 does not start: something else"


def test_a_reset_camera_is_waited_for(told: Any) -> None:
    resets = told["resets"]
    assert resets["found"] == [True, ""]
    assert resets["returned"]
    assert resets["reset_s"] < 1.0
    # The first disappearance was part of the reset; the next one is not.
    assert not resets["removed"]
    assert resets["unplugged"]


def test_the_capture_process_loads_nothing_heavy() -> None:
    script = "import sys, edge_unit.sources.realsense.capture_process; print(*sys.modules)"
    modules = subprocess.run((sys.executable, "-c", script), capture_output=True, text=True, check=True).stdout.split()
    assert not {"numba", "pydantic", "cv2", "httpx", "edge_unit.pipeline.depth_pipeline"} & set(modules)
