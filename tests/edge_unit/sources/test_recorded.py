# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from pydantic import ValidationError

from edge_unit.sources.frame import DepthFrame
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import SourceError

INFO = {"width": 4, "height": 3, "k": [5.0, 0.0, 1.5, 0.0, 6.0, 1.0, 0.0, 0.0, 1.0], "d": [0.0] * 5, "frame_id": "x"}


def image(value: int) -> NDArray[np.uint16]:
    return np.full((3, 4), value, np.uint16)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve frames whose depth is their number, with joints and pose."""
    made = tmp_path / "set"
    (made / "depth").mkdir(parents=True)
    for number in range(12):
        cv2.imwrite(str(made / "depth" / f"{number}.png"), image(number))
    (made / "camera_info.yaml").write_text(yaml.safe_dump(INFO))
    np.savetxt(made / "joint_states_rad.csv", [[n, -n] for n in range(12)], delimiter=",", header="a,b")
    np.savetxt(made / "T_base_optical.txt", np.eye(4))
    return made


def source(folder: Path, **more: Any) -> RecordedSource:
    return RecordedSource(RecordedSourceConfig(folder=folder, **more))


async def play(folder: Path, limit: int = 100, **more: Any) -> list[DepthFrame]:
    playing = source(folder, **more)
    await playing.open()
    frames = []
    async for frame in playing.frames():
        frames.append(frame)
        if len(frames) == limit:
            break
    await playing.close()
    return frames


async def test_frames_come_in_order_with_their_joints(folder: Path) -> None:
    frames = await play(folder)
    assert [int(frame.depth[0, 0]) for frame in frames] == list(range(12))
    assert [frame.frame_number for frame in frames] == list(range(12))
    for number, frame in enumerate(frames):
        assert frame.depth.dtype == np.uint16
        assert frame.joints is not None
        assert frame.joints.tolist() == [number, -number]


async def test_frames_in_the_configured_order(folder: Path) -> None:
    frames = await play(folder, frames=[10, "3", "3.png", 0])
    assert [int(frame.depth[0, 0]) for frame in frames] == [10, 3, 3, 0]
    assert [frame.joints.tolist()[0] for frame in frames if frame.joints is not None] == [10, 3, 3, 0]


async def test_a_loop_goes_on_and_numbers_rise(folder: Path) -> None:
    frames = await play(folder, limit=5, frames=[1, 2], loop=True)
    assert [int(frame.depth[0, 0]) for frame in frames] == [1, 2, 1, 2, 1]
    assert [frame.frame_number for frame in frames] == [0, 1, 2, 3, 4]


async def test_frames_are_paced(folder: Path) -> None:
    frames = await play(folder, frames=[0, 1, 2, 3, 4], fps=50.0)
    # The first may be late, the last is not early.
    assert frames[-1].captured_at_ns - frames[0].captured_at_ns >= 0.06 * NS_PER_S
    assert frames[-1].captured_at_ns <= monotonic_ns()


async def test_the_camera_is_described(folder: Path) -> None:
    info = await source(folder, depth_scale_m=0.0005, fx_stereo=7.0, stereo_baseline_m=0.095).open()
    assert re.fullmatch("set-[0-9a-f]{8}", info.serial)
    assert info.model == "recorded"
    camera = info.intrinsics
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (4, 3, 5.0, 6.0, 1.5, 1.0)
    assert (camera.depth_scale_m, camera.stereo_focal_px, camera.stereo_baseline_m) == (0.0005, 7.0, 0.095)
    assert info.T_world_camera is not None
    assert (await source(folder, serial="X1").open()).serial == "X1"


async def test_folders_of_one_name_are_two_cameras(folder: Path, tmp_path: Path) -> None:
    twin = tmp_path / "elsewhere" / folder.name
    shutil.copytree(folder, twin)
    first, second = await source(folder).open(), await source(twin).open()
    assert first.serial != second.serial
    assert first.serial == (await source(folder / ".." / folder.name).open()).serial


async def test_pose_and_joints_may_be_missing(folder: Path) -> None:
    (folder / "joint_states_rad.csv").unlink()
    (folder / "T_base_optical.txt").unlink()
    assert (await source(folder).open()).T_world_camera is None
    assert (await play(folder, limit=1))[0].joints is None


async def test_npz_and_npy(tmp_path: Path) -> None:
    (tmp_path / "camera_info.yaml").write_text(yaml.safe_dump(INFO))
    np.savez(tmp_path / "0.npz", depth=image(1), colour=np.zeros(3))
    np.savez_compressed(tmp_path / "1.npz", anything=image(2))
    np.save(tmp_path / "2.npy", image(3))
    assert [int(frame.depth[0, 0]) for frame in await play(tmp_path)] == [1, 2, 3]


def break_it(folder: Path, how: str) -> None:
    """One fault that a folder may have."""
    first, info = folder / "depth" / "0.png", folder / "camera_info.yaml"
    match how:
        case "no folder":
            folder.rename(folder.with_name("away"))
        case "no images":
            for file in (folder / "depth").iterdir():
                file.unlink()
        case "no info":
            info.unlink()
        case "info is text":
            info.write_text("a: [")
        case "info lacks":
            info.write_text(yaml.safe_dump({**INFO, "k": [1.0]}))
        case "distorted":
            info.write_text(yaml.safe_dump({**INFO, "d": [0.1, 0.0]}))
        case "focal length":
            info.write_text(yaml.safe_dump({**INFO, "k": [0.0] * 9}))
        case "pose":
            (folder / "T_base_optical.txt").write_text("1 2 3")
        case "joints count":
            (folder / "joint_states_rad.csv").write_text("1,2\n")
        case "joints nan":
            (folder / "joint_states_rad.csv").write_text("nan,2\n" * 12)
        case "joints text":
            (folder / "joint_states_rad.csv").write_text("a,b\n" * 12)
        case "no png":
            first.write_bytes(b"nothing")
        case "empty png":
            first.write_bytes(b"")
        case "8 bits":
            cv2.imwrite(str(first), np.zeros((3, 4), np.uint8))
        case "other size":
            cv2.imwrite(str(first), np.zeros((3, 5), np.uint16))
        case _:
            raise AssertionError(how)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("no folder", "set: expected the folder of a recording"),
        ("no images", "depth: expected depth images"),
        ("no info", "camera_info.yaml: cannot be read"),
        ("info is text", "camera_info.yaml: expected YAML"),
        ("info lacks", "camera_info.yaml: k: "),
        ("distorted", "camera_info.yaml: d: expected images without distortion"),
        ("focal length", "camera_info.yaml: k: "),
        ("pose", "T_base_optical.txt: "),
        ("joints count", "joint_states_rad.csv: expected 12 rows, one for each depth image, got 1"),
        ("joints nan", "joint_states_rad.csv: expected a row of joint positions for each frame: expected finite"),
        ("joints text", "joint_states_rad.csv: expected a row of joint positions for each frame: line 2: "),
        ("no png", "0.png: expected an image, got another file"),
        ("empty png", "0.png: expected an image, got another file"),
        ("8 bits", "0.png: depth: expected dtype uint16"),
        ("other size", "camera_info.yaml: width, height: expected those of the images, 5 x 3, got 4 x 3"),
    ],
)
async def test_an_error_names_the_file(folder: Path, how: str, words: str) -> None:
    break_it(folder, how)
    with pytest.raises(SourceError) as caught:
        await play(folder)
    assert words in str(caught.value)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04broken", b"\x93NUMPY"])
@pytest.mark.parametrize("suffix", [".npz", ".npy"])
async def test_a_broken_array_is_named(tmp_path: Path, content: bytes, suffix: str) -> None:
    (tmp_path / "camera_info.yaml").write_text(yaml.safe_dump(INFO))
    (tmp_path / f"0{suffix}").write_bytes(content)
    with pytest.raises(SourceError, match=f"0{suffix}: cannot be read"):
        await play(tmp_path)


async def test_an_npz_of_several_arrays_must_name_one(tmp_path: Path) -> None:
    (tmp_path / "camera_info.yaml").write_text(yaml.safe_dump(INFO))
    np.savez(tmp_path / "0.npz", a=image(1), b=image(2))
    with pytest.raises(SourceError, match="expected an array named depth, got a, b"):
        await play(tmp_path)


async def test_a_frame_that_is_not_there_is_named(folder: Path) -> None:
    with pytest.raises(SourceError, match="no frame 12; expected names such as 0, or 0 to 11"):
        await play(folder, frames=[12])


async def test_frames_before_opening_are_an_error(folder: Path) -> None:
    with pytest.raises(SourceError, match="expected an open source"):
        async for _ in source(folder).frames():
            pass


@pytest.mark.parametrize("more", [{"fps": 0}, {"frames": [1.5]}, {"kind": "live"}, {"speed": 2}])
def test_wrong_configuration_is_refused(tmp_path: Path, more: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        RecordedSourceConfig(folder=tmp_path, **more)


def test_the_folder_may_begin_with_a_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CELLWATCH_DATA", str(tmp_path))
    assert RecordedSourceConfig(folder="$CELLWATCH_DATA/set").folder == tmp_path / "set"


async def test_the_real_recording(data_dir: Path) -> None:
    frames = await play(data_dir / "xarm7_realsense", limit=2)
    assert frames[1].depth.shape == (720, 1280)
    assert frames[1].joints is not None
    assert frames[1].joints[0] == pytest.approx(0.377113074)
