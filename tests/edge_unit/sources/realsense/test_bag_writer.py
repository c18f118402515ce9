# SPDX-License-Identifier: Apache-2.0
"""A folder of images, recorded and played through the SDK, gives the same frames."""

from __future__ import annotations

import asyncio
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from edge_unit.sources.realsense.bag_writer import joints_path, played, record_images
from edge_unit.sources.realsense.source import RealsenseSource
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from shared.errors import SourceError
from tests.edge_unit.sources.realsense import recordings

FPS = 60.0


@pytest.fixture(scope="module", autouse=True)
def sdk(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Skip if the SDK cannot be imported."""
    recordings.write(tmp_path_factory.mktemp("probe") / "probe.db3", 1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Nine noisy images with all border values of sixteen bits."""
    random = np.random.default_rng(3)
    (tmp_path / "depth").mkdir()
    for number in range(9):
        depth = random.integers(0, 65536, (48, 64), np.uint16)
        depth[0, :3] = 0, 1, 65535
        cv2.imwrite(str(tmp_path / "depth" / f"{number:02}.png"), depth)
    info = {"width": 64, "height": 48, "k": [60.125, 0, 31.7, 0, 61.25, 23.1, 0, 0, 1], "d": [0, 0, 0, 0, 0]}
    (tmp_path / "camera_info.yaml").write_text(yaml.safe_dump(info))
    np.savetxt(tmp_path / "joint_states_rad.csv", random.random((9, 3)), delimiter=",")
    return tmp_path


async def check_same(images: RecordedSourceConfig, recording: Path) -> int:
    """Check that every frame, its joints and the camera are equal in both; returns the number of frames."""
    first = RecordedSource(images)
    second = RealsenseSource(await asyncio.to_thread(played, images, recording))
    count = 0
    try:
        expected, info = await first.open(), await second.open()
        assert (info.serial, info.model) == (expected.serial, expected.model)
        lens, wanted = (each.intrinsics.model_dump(exclude_none=True) for each in (info, expected))
        # The SDK keeps a lens in single precision, and the scale that was meant.
        assert lens["depth_scale_m"] == wanted["depth_scale_m"]
        assert lens == pytest.approx(wanted, rel=1e-7)
        frames = second.frames()
        async for frame in first.frames():
            again = await anext(frames)
            np.testing.assert_array_equal(again.depth, frame.depth)
            assert again.frame_number == frame.frame_number + 1
            assert frame.joints is not None
            assert again.joints is not None
            np.testing.assert_array_equal(again.joints, frame.joints)
            count += 1
        with pytest.raises(StopAsyncIteration):
            await anext(frames)
    finally:
        await second.close()
    return count


async def test_images_survive_bit_for_bit(folder: Path, tmp_path: Path) -> None:
    images = RecordedSourceConfig(
        folder=folder, serial="A1", depth_scale_m=0.00025, stereo_baseline_m=0.095, fx_stereo=55.0
    )
    recording = tmp_path / "images.db3"
    assert await asyncio.to_thread(record_images, images, recording, FPS) == 9
    assert await check_same(images, recording) == 9


async def test_chosen_frames_keep_their_order_and_their_joints(folder: Path, tmp_path: Path) -> None:
    images = RecordedSourceConfig(folder=folder, frames=("07", "02", 3))
    recording = tmp_path / "images.db3"
    assert await asyncio.to_thread(record_images, images, recording, FPS) == 3
    assert await check_same(images, recording) == 3


async def test_joints_of_a_recording_before_are_gone(folder: Path, tmp_path: Path) -> None:
    recording = tmp_path / "images.db3"
    await asyncio.to_thread(record_images, RecordedSourceConfig(folder=folder), recording, FPS)
    (folder / "joint_states_rad.csv").unlink()
    await asyncio.to_thread(record_images, RecordedSourceConfig(folder=folder), recording, FPS)
    assert not joints_path(recording).exists()


async def test_real_frames_survive_bit_for_bit(data_dir: Path, tmp_path: Path) -> None:
    images = RecordedSourceConfig(folder=data_dir / "xarm7_realsense")
    recording = tmp_path / "xarm7.db3"
    assert await asyncio.to_thread(record_images, images, recording, FPS) == 10
    assert await check_same(images, recording) == 10


def test_errors_name_the_file(folder: Path, tmp_path: Path) -> None:
    images = RecordedSourceConfig(folder=folder)
    with pytest.raises(SourceError, match=r"out\.bag: expected a name that ends in \.db3"):
        record_images(images, tmp_path / "out.bag", FPS)
    with pytest.raises(SourceError, match=r"nowhere/out\.db3: cannot be written"):
        record_images(images, tmp_path / "nowhere" / "out.db3", FPS)
    with pytest.raises(SourceError, match=r"nothing: expected the folder of a recording"):
        record_images(RecordedSourceConfig(folder=tmp_path / "nothing"), tmp_path / "out.db3", FPS)
    (folder / "depth" / "04.png").write_bytes(b"no image")
    with pytest.raises(SourceError, match=r"04\.png: expected an image, got another file"):
        record_images(images, tmp_path / "out.db3", FPS)
    assert not (tmp_path / "out.db3").exists()
