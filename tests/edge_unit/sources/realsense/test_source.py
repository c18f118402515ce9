# SPDX-License-Identifier: Apache-2.0
"""The RealSense source with the real SDK: recordings, cameras that come and go, processes that hang and crash."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from edge_unit.sources.frame import CameraInfo, DepthFrame
from edge_unit.sources.realsense.source import RealsenseSource, RealsenseSourceConfig
from edge_unit.sources.status import ReportsStatus, SourceStatus
from shared.camera import Intrinsics
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import SourceError
from simulation.cameras.pluggable import command, plug
from tests.edge_unit.sources.realsense import recordings
from tests.edge_unit.sources.realsense.recordings import depth_of

pytestmark = pytest.mark.alone

FRAMES = 45


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second and a half of depth, infrared and colour."""
    return recordings.write(tmp_path_factory.mktemp("recordings") / "camera.db3", FRAMES, images=1)


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another camera, at a USB 2 port."""
    return recordings.write(tmp_path_factory.mktemp("recordings") / "other.db3", 15, serial="SYN0002", usb=2.1)


@asynccontextmanager
async def opened(**config: Any) -> AsyncIterator[tuple[RealsenseSource, CameraInfo]]:
    source = RealsenseSource(RealsenseSourceConfig(**config))
    try:
        yield source, await source.open()
    finally:
        await source.close()
        assert source.status.state == "closed"


async def until(source: RealsenseSource, wanted: Callable[[SourceStatus], bool]) -> SourceStatus:
    seen = [source.status]

    async def look() -> None:
        while not wanted(seen[-1]):
            seen.append(await source.next_status(seen[-1]))

    try:
        await asyncio.wait_for(look(), 10.0)
    except asyncio.TimeoutError:
        pytest.fail("\n".join(str(status) for status in seen))
    return seen[-1]


def check(frame: DepthFrame) -> None:
    number = (frame.frame_number - 1) % FRAMES + 1
    np.testing.assert_array_equal(frame.depth, depth_of(number))


# ---------------------------------------------------------------------- recordings


async def test_a_recording_gives_every_frame_once_bit_for_bit(recording: Path) -> None:
    async with opened(recording=recording, real_time=False) as (source, info):
        assert isinstance(source, ReportsStatus)
        assert info == CameraInfo(
            "SYN0001",
            "Synthetic D435",
            Intrinsics(
                recordings.WIDTH,
                recordings.HEIGHT,
                recordings.FX,
                recordings.FY,
                recordings.CX,
                recordings.CY,
                depth_scale_m=recordings.DEPTH_SCALE_M,
                stereo_baseline_m=recordings.BASELINE_M,
            ),
        )
        numbers, captured = [], []
        async for frame in source.frames():
            check(frame)
            numbers.append(frame.frame_number)
            captured.append(frame.captured_at_ns)
            assert frame.joints is None
            if frame.frame_number == 20:
                await asyncio.sleep(0.3)  # a slow reader loses nothing
        assert numbers == list(range(1, FRAMES + 1))
        assert captured == sorted(captured)
        assert source.status.state == "ended"
        assert source.status.trouble is None


async def test_at_its_own_pace_the_latest_wins_and_times_are_those_of_the_camera(recording: Path) -> None:
    async with opened(recording=recording) as (source, _):
        numbers, ages_ms, captured = [], [], []
        async for frame in source.frames():
            check(frame)
            ages_ms.append((monotonic_ns() - frame.captured_at_ns) / NS_PER_MS)
            numbers.append(frame.frame_number)
            captured.append(frame.captured_at_ns)
            if frame.frame_number == 10:
                await asyncio.sleep(0.5)
        assert numbers == sorted(set(numbers))
        assert FRAMES - 20 <= len(numbers) < FRAMES - 9
        assert min(ages_ms) >= 0.0
        # Stamps of a steady camera are steady, whenever frames arrive.
        paces = np.diff(captured) / np.diff(numbers) / NS_PER_S * recordings.FPS
        assert abs(np.median(paces) - 1.0) < 0.05


async def test_a_looped_recording_never_gives_a_number_twice(recording: Path) -> None:
    async with opened(recording=recording, real_time=False, loop=True) as (source, _):
        numbers = []
        async for frame in source.frames():
            check(frame)
            numbers.append(frame.frame_number)
            if len(numbers) == 2 * FRAMES + 5:
                break
        assert numbers == list(range(1, 2 * FRAMES + 6))


async def test_joints_come_from_the_file_beside_it(recording: Path, tmp_path: Path) -> None:
    joints = tmp_path / "joints.csv"
    np.savetxt(joints, np.arange(2 * FRAMES).reshape(FRAMES, 2) / 10, delimiter=",")
    async with opened(recording=recording, real_time=False, joints_file=joints) as (source, _):
        async for frame in source.frames():
            assert frame.joints is not None
            np.testing.assert_allclose(frame.joints, [(frame.frame_number - 1) / 5, (frame.frame_number - 1) / 5 + 0.1])


async def test_too_few_rows_of_joints_are_named(recording: Path, tmp_path: Path) -> None:
    joints = tmp_path / "joints.csv"
    np.savetxt(joints, np.zeros((3, 2)), delimiter=",")
    async with opened(recording=recording, real_time=False, joints_file=joints) as (source, _):
        with pytest.raises(SourceError, match=r"joints.csv: expected a row for frame 4, got 3 rows"):
            async for _frame in source.frames():
                pass


async def test_a_usb_2_port_is_a_warning(other: Path) -> None:
    async with opened(recording=other) as (source, _):
        status = await until(source, lambda status: status.state == "live")
        assert status.trouble is None
        assert status.warning == "the camera is at a USB 2.1 port or cable; use a USB 3 port and its cable"


async def test_a_recording_cut_in_half_is_refused_with_its_name(recording: Path, tmp_path: Path) -> None:
    half = tmp_path / "half.db3"
    half.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    source = RealsenseSource(RealsenseSourceConfig(recording=half))
    with pytest.raises(SourceError, match=r"half\.db3: expected a recording that can be played; it may be truncated"):
        await source.open()
    assert source.pid is None


async def test_a_missing_recording_is_named() -> None:
    with pytest.raises(SourceError, match=r"nowhere\.db3: expected a recording"):
        await RealsenseSource(RealsenseSourceConfig(recording=Path("nowhere.db3"))).open()


async def test_no_frames_before_open() -> None:
    with pytest.raises(SourceError, match="expected an open source"):
        async for _ in RealsenseSource(RealsenseSourceConfig()).frames():
            pass


# ---------------------------------------------------------------------- processes that die and hang


async def test_a_killed_capture_process_costs_no_frame_of_a_recording(recording: Path) -> None:
    async with opened(recording=recording, real_time=False) as (source, _):
        numbers, pids = [], set()
        async for frame in source.frames():
            check(frame)
            numbers.append(frame.frame_number)
            pids.add(source.pid)
            if frame.frame_number in (12, 30):
                assert source.pid is not None
                os.kill(source.pid, signal.SIGKILL)
        assert numbers == list(range(1, FRAMES + 1))
        assert len(pids - {None}) == 3


async def test_a_hung_capture_process_is_reported_within_a_second_and_replaced(recording: Path) -> None:
    async with opened(recording=recording, loop=True) as (source, _):
        await until(source, lambda status: status.state == "live")
        hung = source.pid
        assert hung is not None
        os.kill(hung, signal.SIGSTOP)
        stopped_ns = monotonic_ns()
        status = await until(source, lambda status: status.state != "live")
        assert status.since_ns - stopped_ns < NS_PER_S
        assert status.trouble == "camera silent: the camera sends no frames"
        status = await until(source, lambda status: status.state == "live")
        assert status.since_ns - stopped_ns < 4 * NS_PER_S
        assert source.pid != hung
        assert not Path(f"/proc/{hung}").exists()
        frames = source.frames()
        numbers = [(await anext(frames)).frame_number for _ in range(5)]
        assert numbers == sorted(set(numbers))
        await frames.aclose()


async def test_closing_a_hung_capture_process_takes_no_longer_than_it_should(recording: Path) -> None:
    source = RealsenseSource(RealsenseSourceConfig(recording=recording, loop=True))
    await source.open()
    hung = source.pid
    assert hung is not None
    os.kill(hung, signal.SIGSTOP)
    began_ns = monotonic_ns()
    await source.close()
    assert monotonic_ns() - began_ns < 2 * NS_PER_S
    assert not Path(f"/proc/{hung}").exists()


async def test_a_frame_stays_as_it_was_while_its_process_dies(recording: Path) -> None:
    async with opened(recording=recording, loop=True) as (source, _):
        frames = source.frames()
        frame = await anext(frames)
        assert source.pid is not None
        os.kill(source.pid, signal.SIGKILL)
        await until(source, lambda status: status.state == "restarting")
        await until(source, lambda status: status.state == "live")
        check(frame)
        await frames.aclose()
    check(frame)


async def test_it_may_be_opened_again(recording: Path) -> None:
    source = RealsenseSource(RealsenseSourceConfig(recording=recording))
    for _ in range(2):
        await source.open()
        frames = source.frames()
        check(await anext(frames))
        await frames.aclose()
        await source.close()
    await source.close()


# ---------------------------------------------------------------------- cameras that come and go


async def test_an_absent_camera_is_named_with_the_connected_ones() -> None:
    source = RealsenseSource(RealsenseSourceConfig(serial="123456", open_timeout_s=1.0))
    opening = asyncio.create_task(source.open())
    status = await until(source, lambda status: status.state == "absent")
    assert status.trouble == "camera absent: no RealSense camera 123456 is connected (connected: none)"
    with pytest.raises(SourceError, match="no RealSense camera 123456 is connected"):
        await opening
    assert source.status.state == "closed"


async def test_a_camera_may_be_unplugged_and_plugged_in_again(recording: Path, tmp_path: Path) -> None:
    sockets = tmp_path / "sockets"
    source = RealsenseSource(RealsenseSourceConfig(serial="SYN0001"), command(sockets))
    opening = asyncio.create_task(source.open())
    await until(source, lambda status: status.state == "absent")
    await asyncio.to_thread(plug, sockets, [recording])
    assert (await opening).serial == "SYN0001"
    numbers = []

    async def read() -> None:
        async for frame in source.frames():
            numbers.append(frame.frame_number)

    reading = asyncio.create_task(read())
    await until(source, lambda status: status.state == "live")
    for _ in range(2):
        await asyncio.to_thread(plug, sockets, [])
        unplugged_ns = monotonic_ns()
        status = await until(source, lambda status: status.state != "live")
        assert status.reason == "camera SYN0001 was unplugged"
        assert status.since_ns - unplugged_ns < NS_PER_S // 2
        status = await until(source, lambda status: status.state == "absent")
        assert status.reason == "no RealSense camera SYN0001 is connected (connected: none)"
        await asyncio.to_thread(plug, sockets, [recording])
        await until(source, lambda status: status.state == "live")
    await asyncio.sleep(0.2)
    await source.close()
    await asyncio.wait_for(reading, 1.0)
    assert len(numbers) >= 3
    assert numbers == sorted(set(numbers))


async def test_another_camera_is_never_taken_for_the_first(recording: Path, other: Path, tmp_path: Path) -> None:
    sockets = tmp_path / "sockets"
    await asyncio.to_thread(plug, sockets, [recording])
    source = RealsenseSource(RealsenseSourceConfig(), command(sockets))
    assert (await source.open()).serial == "SYN0001"
    await asyncio.to_thread(plug, sockets, [other])
    with pytest.raises(SourceError, match=r"expected the camera SYN0001 \(424x240\), got SYN0002 \(424x240\)"):
        async for _ in source.frames():
            pass
    await source.close()
    assert (await source.open()).serial == "SYN0002"
    await source.close()


async def test_of_two_cameras_one_must_be_chosen(recording: Path, other: Path, tmp_path: Path) -> None:
    sockets = tmp_path / "sockets"
    await asyncio.to_thread(plug, sockets, [recording, other])
    source = RealsenseSource(RealsenseSourceConfig(open_timeout_s=1.0), command(sockets))
    with pytest.raises(SourceError, match=r"2 RealSense cameras are connected \(SYN0001, SYN0002\); choose one"):
        await source.open()


# ---------------------------------------------------------------------- the calibration board


async def test_depth_resumes_after_images_of_the_board(recording: Path) -> None:
    async with opened(recording=recording, real_time=False) as (source, info):
        frames = source.frames()
        first = [(await anext(frames)).frame_number for _ in range(3)]
        async with source.open_images("color") as feed:
            assert source.status.state == "looking" or source.status.state == "starting"
            assert feed.info.intrinsics.fx == info.intrinsics.fx
            assert feed.info.distortion == (0.0,) * 5
            np.testing.assert_allclose(feed.info.T_depth_image[:3, 3], recordings.COLOR_AT_M, atol=1e-7)
            np.testing.assert_allclose(feed.info.T_depth_image[:3, :3], np.eye(3))
            images = feed.images()
            for _ in range(2):
                image = await anext(images)
                assert image.pixels.shape == (recordings.HEIGHT, recordings.WIDTH, 3)
                assert (image.pixels == image.frame_number).all()
        async with source.open_images("infrared") as feed:
            image = await anext(feed.images())
            assert image.pixels.shape == (recordings.HEIGHT, recordings.WIDTH)
            assert (image.pixels == image.frame_number).all()
            np.testing.assert_allclose(feed.info.T_depth_image, np.eye(4))
        rest = [frame.frame_number async for frame in frames]
        assert first + rest == list(range(1, FRAMES + 1))


async def test_a_stream_that_is_not_there_is_named_and_depth_goes_on(other: Path) -> None:
    async with opened(recording=other, loop=True) as (source, _):
        with pytest.raises(SourceError, match=r"other\.db3: no color stream \(rgb8\) was recorded"):
            async with source.open_images("color"):
                pass
        await until(source, lambda status: status.state == "live")


# ---------------------------------------------------------------------- configuration


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"width": 800}, "expected one of 424x240, 480x270, 640x480, 848x480, 1280x720, got 800x480"),
        ({"loop": True}, "loop is for a recording"),
        ({"real_time": False}, "real_time is for a recording"),
        ({"joints_file": "a.csv"}, "joints_file is for a recording"),
        ({"serial": "1", "recording": "a.db3"}, "got both"),
        ({"fps": 25}, "6, 15, 30, 60 or 90"),
        ({"sereal": "1"}, "Extra inputs"),
    ],
)
def test_contradictory_settings_are_refused(wrong: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        RealsenseSourceConfig(**wrong)
