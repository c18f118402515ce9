# SPDX-License-Identifier: Apache-2.0
"""The camera of the last run."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_unit.monitoring.last_camera import CameraMemory
from edge_unit.sources.frame import CameraInfo
from shared.camera import Intrinsics
from shared.files import STATE_MAX_BYTES

CAMERA = CameraInfo("123", "D435", Intrinsics(848, 480, 424.1, 424.2, 423.9, 239.8, 0.00025, 0.0501, 420.0))


def test_the_last_one_is_remembered(tmp_path: Path) -> None:
    memory = CameraMemory(tmp_path / "state")
    assert memory.load() is None
    memory.save(CameraInfo("1", "D405", CAMERA.intrinsics))
    memory.save(CAMERA)
    assert CameraMemory(tmp_path / "state").load() == CAMERA


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"serial": 1, "model": "", "intrinsics": {"width": 0}}', "x" * 20_000]
)
def test_a_damaged_file_is_as_good_as_none(tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "camera.json").write_text(text)
    assert CameraMemory(tmp_path).load() is None
    assert "camera.json: ignored" in caplog.text


def test_a_failed_write_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "state").write_text("a file where a folder should be")
    CameraMemory(tmp_path / "state").save(CAMERA)
    assert "camera.json: cannot be written" in caplog.text


def test_a_written_file_can_be_read(tmp_path: Path) -> None:
    CameraMemory(tmp_path).save(CAMERA)
    assert (tmp_path / "camera.json").stat().st_size < STATE_MAX_BYTES / 5
