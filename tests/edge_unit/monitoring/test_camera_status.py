# SPDX-License-Identifier: Apache-2.0
"""The camera that is reported to the master."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from edge_unit.config import UnitConfig
from edge_unit.monitoring import CameraStatus
from edge_unit.monitoring.last_camera import CameraMemory
from edge_unit.sources.frame import CameraInfo
from edge_unit.sources.realsense.source import RealsenseSourceConfig
from edge_unit.uplink.uplink import CameraState
from shared.camera import Intrinsics
from shared.errors import SourceError
from shared.messages import MAX_TEXT, Health

CAMERA = CameraInfo("123", "D435", Intrinsics(848, 480, 424.1, 424.2, 423.9, 239.8))


class Told:
    """Replaces the uplink."""

    def __init__(self) -> None:
        self.cameras: list[CameraInfo] = []
        self.camera_state = CameraState()

    def set_camera(self, camera: CameraInfo, known_pose: object) -> None:
        self.cameras.append(camera)


def standing(folder: Path, serial: str | None = None) -> tuple[CameraStatus, Any]:
    told: Any = Told()
    return CameraStatus(UnitConfig(source=RealsenseSourceConfig(serial=serial), state_dir=folder), told), told


@pytest.mark.parametrize(("wanted", "expected"), [(None, [CAMERA]), ("123", [CAMERA]), ("456", [])])
async def test_the_one_of_before_is_missed_if_it_is_wanted(
    tmp_path: Path, wanted: str | None, expected: list[CameraInfo]
) -> None:
    await asyncio.to_thread(CameraMemory(tmp_path).save, CAMERA)
    camera, told = standing(tmp_path, wanted)
    await camera.failed(SourceError("x" * 2 * MAX_TEXT))
    assert told.cameras == expected
    assert told.camera_state.trouble.code == "camera"
    assert len(Health(**told.camera_state.trouble.facts()).trouble or "") == MAX_TEXT


async def test_one_that_is_here_is_remembered_and_no_other_is_missed(tmp_path: Path) -> None:
    await asyncio.to_thread(CameraMemory(tmp_path).save, CameraInfo("456", "D405", CAMERA.intrinsics))
    camera, told = standing(tmp_path)
    await camera.opened(CAMERA)
    assert await asyncio.to_thread(CameraMemory(tmp_path).load) == CAMERA
    assert not told.camera_state.trouble
    await camera.failed(SourceError("unplugged"))
    assert told.camera_state.trouble.code == "camera"
    assert "unplugged" in told.camera_state.trouble.sentence
    assert told.cameras == [CAMERA]
