# SPDX-License-Identifier: Apache-2.0
"""A folder of depth images, played as if a camera took them now.

Every frame is delivered once, in order, to a reader of any speed: a recording is for close examination and, unlike a
camera, can wait. Capture times are the times of delivery.
"""

from __future__ import annotations

import asyncio
import hashlib
import io
import logging
import os
import re
import zipfile
from collections.abc import AsyncGenerator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from edge_unit.sources.camera_info_file import read_camera_info
from edge_unit.sources.frame import CameraInfo, DepthFrame
from shared.camera import D435_BASELINE_M, Intrinsics
from shared.clock import NS_PER_S, monotonic_ns
from shared.configuration import Text
from shared.errors import CellwatchError, ConfigError, InputError, SourceError
from shared.text_files import parse_numbers, read_text
from shared.transforms import Transform, rounding_warning, validated

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".tif", ".tiff")

SUFFIXES = (*IMAGE_SUFFIXES, ".npz", ".npy")

NPZ_NAME = "depth"
"""Name of the array in an npz; a single array may have any name."""

SERIAL_NAME_CHARS = 64
"""Part of the folder's name in a serial: enough to recognise it, well within a master's limit."""

SERIAL_HASH_CHARS = 8
"""32 bits: two recordings in one cell do not share them by chance."""

MAX_FILE_BYTES = 256 * 2**20
"""Limit of one image file: many times the largest camera's, so that a wrong file does not fill the memory."""


MAX_FRAMES = 100_000
"""Limit of frames of a recording, named one by one; two hours at 15 fps."""

DEPTH_MAX_M = 200.0
"""Of an image in metres: farther than any depth camera measures, and nearer than a wall is in millimetres."""

ExpandedPath = Annotated[Path, BeforeValidator(lambda value: os.path.expandvars(os.path.expanduser(value)))]
"""May start with `~` or a variable such as `$CELLWATCH_DATA`."""


class RecordedSourceConfig(BaseModel):
    """A folder of 16-bit PNG or npz depth images, with the camera's intrinsics, and its pose and joints if known."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: Literal["recorded"] = "recorded"
    folder: ExpandedPath = Field(description="With `depth/` (or the images themselves) and `camera_info.yaml`.")
    frames: tuple[str | int, ...] | None = Field(
        default=None, max_length=MAX_FRAMES, description="Names or numbers, in the order of play; absent: all."
    )
    fps: float | None = Field(default=None, gt=0.0, le=300.0, description="Absent: as fast as the reader takes them.")
    loop: bool = Field(default=False, description="Start again at the end.")
    depth_scale_m: float = Field(default=0.001, ge=1e-6, le=0.1)
    fx_stereo: float | None = Field(default=None, gt=0.0, description="Focal length at which the imagers match.")
    stereo_baseline_m: float = Field(default=D435_BASELINE_M, ge=0.005, le=1.0)
    serial: Text | None = Field(
        default=None, min_length=1, max_length=200, description="Absent: the folder's name and a hash of its path."
    )
    camera_info: str = "camera_info.yaml"
    pose: str = Field(default="T_base_optical.txt", description="T_world_camera; none where there is no such file.")
    joints: str = Field(default="joint_states_rad.csv", description="A row a frame; none where there is no such file.")


@dataclass(frozen=True)
class _Recording:
    """All of a recording but its images."""

    info: CameraInfo
    files: tuple[Path, ...]
    joints: tuple[NDArray[np.float64] | None, ...]


class RecordedSource:
    """A `DepthSource` of a folder."""

    def __init__(self, config: RecordedSourceConfig) -> None:
        self._config = config
        self._recording: _Recording | None = None

    async def open(self) -> CameraInfo:
        """Read the folder's index.

        Raises:
            SourceError: a file is missing or malformed; the text names it.
        """
        self._recording = await asyncio.to_thread(_open, self._config)
        return self._recording.info

    async def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """Yield the frames in order, at the configured rate; stops at the end unless it loops.

        Raises:
            SourceError: the source is not open, or an image cannot be read or does not fit.
        """
        recording = self._recording
        if recording is None:
            raise SourceError(f"{self._config.folder}: expected an open source before frames are read: call open first")
        period_ns = 0 if self._config.fps is None else round(NS_PER_S / self._config.fps)
        number, due_ns = 0, monotonic_ns()
        while True:
            for file, joints in zip(recording.files, recording.joints, strict=True):
                depth = await asyncio.to_thread(_read_image, file, recording.info.intrinsics)
                if (wait_ns := due_ns - monotonic_ns()) > 0:
                    await asyncio.sleep(wait_ns / NS_PER_S)
                captured_at_ns = monotonic_ns()
                yield DepthFrame(depth, captured_at_ns, number, joints)
                number += 1
                # A late reader does not speed up the following frames.
                due_ns = max(due_ns + period_ns, captured_at_ns)
            if not self._config.loop:
                return

    async def close(self) -> None:
        """Do nothing: no resource is held."""
        self._recording = None


def read_pose(path: Path) -> Transform:
    """Read `T_world_camera` from a text file: a 4x4 matrix, its first three rows, or all 16 numbers in one row.

    Raises:
        ConfigError: it cannot be read, or is not a rigid transform; the text names the file.
    """
    try:
        matrix = parse_numbers(read_text(path))
        if matrix.shape == (1, 16):
            matrix = matrix.reshape(4, 4)
        elif matrix.shape == (3, 4):
            matrix = np.vstack((matrix, (0.0, 0.0, 0.0, 1.0)))
        pose = validated(matrix, "T_world_camera")
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from error
    if warning := rounding_warning(matrix, pose):
        logger.warning("%s: T_world_camera: %s", path, warning)
    return pose


def open_recording(config: RecordedSourceConfig) -> CameraInfo:
    """Read the camera of a recording, without its frames.

    Raises:
        SourceError: a file is missing or malformed; the text names it.
    """
    return _open(config).info


def _open(config: RecordedSourceConfig) -> _Recording:
    folder = config.folder
    if not folder.is_dir():
        raise SourceError(f"{folder}: expected the folder of a recording, and there is none")
    images = folder / "depth" if (folder / "depth").is_dir() else folder
    every = sorted((path for path in images.iterdir() if path.suffix in SUFFIXES), key=_place)
    if not every:
        raise SourceError(f"{images}: expected depth images ({', '.join(SUFFIXES)}), and there are none")
    files = every if config.frames is None else [_named(images, every, name) for name in config.frames]
    pose, joints = folder / config.pose, folder / config.joints
    try:
        info = CameraInfo(
            config.serial or _serial(folder),
            "recorded",
            _intrinsics(folder / config.camera_info, files[0], config),
            read_pose(pose) if pose.is_file() else None,
        )
    except SourceError:
        raise
    except CellwatchError as error:
        raise SourceError(str(error)) from error
    rows = _joints(joints, len(every)) if joints.is_file() else None
    return _Recording(info, tuple(files), tuple(None if rows is None else rows[every.index(file)] for file in files))


def _serial(folder: Path) -> str:
    """Make a serial for a recording without one: two folders of the same name are two cameras."""
    path = folder.resolve()
    name = "".join(char if char.isprintable() else "_" for char in path.name)[:SERIAL_NAME_CHARS]
    return f"{name}-{hashlib.sha256(os.fsencode(path)).hexdigest()[:SERIAL_HASH_CHARS]}"


def _place(path: Path) -> list[str | int]:
    """Sort key that puts frame 10 after frame 9."""
    return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", path.name)]


def _named(images: Path, every: list[Path], name: str | int) -> Path:
    """Return the file with that stem, or the one at that index."""
    for file in every:
        if str(name) in (file.stem, file.name):
            return file
    if isinstance(name, int) and 0 <= name < len(every):
        return every[name]
    raise SourceError(f"{images}: no frame {name!r}; expected names such as {every[0].stem}, or 0 to {len(every) - 1}")


def _intrinsics(path: Path, first: Path, config: RecordedSourceConfig) -> Intrinsics:
    """The intrinsics of the images of which `first` is one."""
    pinhole = read_camera_info(path, _shape(first))
    try:
        return Intrinsics(
            width=pinhole.width,
            height=pinhole.height,
            fx=pinhole.fx,
            fy=pinhole.fy,
            cx=pinhole.cx,
            cy=pinhole.cy,
            depth_scale_m=config.depth_scale_m,
            stereo_baseline_m=config.stereo_baseline_m,
            fx_stereo=config.fx_stereo,
        )
    except InputError as error:
        raise SourceError(f"{path}: {error}") from error


def _joints(path: Path, frame_count: int) -> NDArray[np.float64]:
    """Read joint positions (frames, n)."""
    try:
        rows = parse_numbers(read_text(path))
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: expected a row of joint positions for each frame: {error}") from error
    if len(rows) != frame_count:
        raise SourceError(f"{path}: expected {frame_count} rows, one for each depth image, got {len(rows)}")
    return rows


def _shape(path: Path) -> tuple[int, int]:
    """(height, width) of a depth image."""
    depth = _opened(path)
    if depth.ndim != 2:
        raise SourceError(f"{path}: expected a depth image of one channel, got an array of shape {depth.shape}")
    return int(depth.shape[0]), int(depth.shape[1])


def _read_image(path: Path, intrinsics: Intrinsics) -> NDArray[np.uint16]:
    try:
        return intrinsics.check_depth(_raw_depth(_opened(path), intrinsics.depth_scale_m))
    except InputError as error:
        raise SourceError(f"{path}: {error}") from error


def _raw_depth(depth: NDArray[Any], depth_scale_m: float) -> NDArray[Any]:
    """Depth in metres (float, NaN or infinite where nothing was measured) as uint16 in units of `depth_scale_m`.

    Other images are returned as they are. Depth beyond what uint16 holds counts as not measured.
    """
    if depth.dtype.kind != "f":
        return depth
    finite = depth[np.isfinite(depth)]
    if finite.size and finite.max() > DEPTH_MAX_M:
        raise InputError(
            f"depth: expected metres in an image of {depth.dtype}, got values up to {finite.max():.4g}; "
            "write millimetres as uint16"
        )
    with np.errstate(invalid="ignore", over="ignore"):
        units = np.rint(depth.astype(np.float64) / depth_scale_m)
        return np.where((units >= 1.0) & (units <= np.iinfo(np.uint16).max), units, 0.0).astype(np.uint16)


def _opened(path: Path) -> NDArray[Any]:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise SourceError(f"{path}: expected at most {MAX_FILE_BYTES} bytes")
        return _decoded(path)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error


def _decoded(path: Path) -> NDArray[Any]:
    if path.suffix in IMAGE_SUFFIXES:
        encoded = np.fromfile(path, dtype=np.uint8)
        image = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED) if encoded.size else None
        if image is None:
            raise SourceError(f"{path}: expected an image, got another file")
        return image
    # Read here, since numpy leaves a broken file open.
    loaded = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return loaded
    with loaded:
        names = loaded.files
        if NPZ_NAME not in names and len(names) != 1:
            raise SourceError(f"{path}: expected an array named {NPZ_NAME}, got {', '.join(names) or 'none'}")
        array: NDArray[Any] = loaded[NPZ_NAME if NPZ_NAME in names else names[0]]
        return array
