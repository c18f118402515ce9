# SPDX-License-Identifier: Apache-2.0
"""A RealSense camera, or a recording of one, as a source of frames.

A separate process captures, and frames come through shared memory without a copy. If a camera is unplugged, stalls or
crashes the process, the source waits and restarts the capture, and `status` reports it at once.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from edge_unit.sources.camera_info_file import DISTORTION_MAX_PX, distortion_px
from edge_unit.sources.frame import CameraInfo, DepthFrame
from edge_unit.sources.image import ImageFrame, ImageInfo, ImageStream
from edge_unit.sources.realsense import capture_link as link
from edge_unit.sources.realsense.capture_session import CAPTURE_COMMAND
from edge_unit.sources.realsense.capture_supervisor import CaptureSupervisor
from edge_unit.sources.realsense.shared_frames import SharedFrame
from edge_unit.sources.recorded import ExpandedPath
from edge_unit.sources.status import SourceStatus, StatusBoard
from shared.camera import D435_BASELINE_M, Intrinsics
from shared.clock import NS_PER_MS
from shared.configuration import Text
from shared.errors import InputError, SourceError
from shared.text_files import parse_numbers, read_text

SIZES = ((424, 240), (480, 270), (640, 480), (848, 480), (1280, 720))
"""Depth image sizes that every camera of the D400 family offers; 848x480 is the native size of its stereo."""


class RealsenseSourceConfig(BaseModel):
    """The camera and its image size, or the recording."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: Literal["realsense"] = "realsense"
    serial: Text | None = Field(
        default=None, min_length=1, max_length=64, description="Of the camera; not needed if only one is connected."
    )
    width: int = Field(default=848, description="Columns: 424, 480, 640, 848 or 1280.")
    height: int = Field(default=480, description="Rows: 240, 270, 480, 480 or 720.")
    fps: Literal[6, 15, 30, 60, 90] = 15
    recording: ExpandedPath | None = Field(default=None, description="A .db3 or .bag instead of a camera.")
    real_time: bool = Field(default=True, description="Of a recording: at its own rate; else as fast as the reader.")
    loop: bool = Field(default=False, description="Of a recording: start again at its end.")
    joints_file: ExpandedPath | None = Field(
        default=None, description="Of a recording: rows of joint positions; row i belongs to frame number i + 1."
    )
    fx_stereo: float | None = Field(
        default=None, gt=0.0, description="Focal length in pixels at which the imagers match, if it is not fx."
    )
    arrival_latency_ms: float = Field(
        default=25.0, ge=0.0, le=300.0, description="From exposure to arrival, without a camera clock."
    )
    open_timeout_s: float = Field(default=20.0, gt=0.0, le=600.0, description="For the camera's first frame.")

    @model_validator(mode="after")
    def _consistent(self) -> RealsenseSourceConfig:
        if (self.width, self.height) not in SIZES:
            sizes = ", ".join(f"{width}x{height}" for width, height in SIZES)
            raise ValueError(f"width, height: expected one of {sizes}, got {self.width}x{self.height}")
        if self.recording is None:
            only = {"real_time": not self.real_time, "loop": self.loop, "joints_file": self.joints_file is not None}
            if wrong := next((name for name, given in only.items() if given), None):
                raise ValueError(f"{wrong} is for a recording, and none is set")
        elif self.serial is not None:
            raise ValueError("expected serial (of a camera) or recording, got both")
        return self

    def request(self, stream: link.Stream = "depth") -> link.Request:
        """Return the request for the capture process."""
        return link.Request(
            stream=stream,
            serial=self.serial or "",
            recording="" if self.recording is None else str(self.recording),
            width=self.width,
            height=self.height,
            fps=self.fps,
            latency_ns=round(self.arrival_latency_ms * NS_PER_MS),
            lockstep=not self.real_time,
            loop=self.loop,
        )


class RealsenseImages:
    """Images of one stream, while depth is paused."""

    def __init__(self, info: ImageInfo, supervisor: CaptureSupervisor) -> None:
        self.info = info
        self._supervisor = supervisor

    async def images(self) -> AsyncGenerator[ImageFrame, None]:
        """Yield images as they come, latest-only; ends with a recording.

        Raises:
            SourceError: the camera will deliver no more.
        """
        async for frame in self._supervisor.frames():
            yield ImageFrame(cast("NDArray[np.uint8]", frame.pixels), frame.captured_at_ns, frame.number)


class RealsenseSource:
    """A `DepthSource` that `ReportsStatus`, and an `ImageSource` for the calibration board."""

    def __init__(self, config: RealsenseSourceConfig, command: Sequence[str] = CAPTURE_COMMAND) -> None:
        self._config = config
        self._command = command
        self._board = StatusBoard()
        self._supervisor: CaptureSupervisor | None = None
        self._joints: NDArray[np.float64] | None = None

    # ------------------------------------------------------------------ a depth source

    async def open(self) -> CameraInfo:
        """Start the camera, and wait until it streams.

        Raises:
            SourceError: it does not within `open_timeout_s`, or the recording cannot be played; says what to do.
        """
        config = self._config
        if config.joints_file is not None:
            self._joints = await asyncio.to_thread(_read_joints, config.joints_file)
        self._supervisor = CaptureSupervisor(config.request(), self._board, "live", self._command)
        self._supervisor.begin()
        try:
            return camera_info(await self._supervisor.first_opened(config.open_timeout_s), config.fx_stereo)
        except BaseException:
            await self.close()
            raise

    async def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """Yield frames as they come, latest-only; `depth` lies in shared memory, valid until the next frame is taken.

        This waits while the camera is away, and ends with a recording.

        Raises:
            SourceError: the source is not open, the camera is another one now, or a recording is damaged.
        """
        if self._supervisor is None:
            raise SourceError("the camera: expected an open source before frames are read: call open first")
        async for frame in self._supervisor.frames():
            depth = cast("NDArray[np.uint16]", frame.pixels)
            yield DepthFrame(depth, frame.captured_at_ns, frame.number, self._joints_of(frame))

    async def close(self) -> None:
        """End the capture process; no effect if there is none."""
        supervisor, self._supervisor = self._supervisor, None
        if supervisor is not None:
            await supervisor.close()
        self._board.post("closed")

    # ------------------------------------------------------------------ its status

    @property
    def status(self) -> SourceStatus:
        """The current status."""
        return self._board.now

    async def next_status(self, known: SourceStatus) -> SourceStatus:
        """Wait until the status differs from `known`, and return it."""
        return await self._board.next(known)

    @property
    def opened(self) -> link.Opened | None:
        """All properties that the camera reported when it was opened."""
        return None if self._supervisor is None else self._supervisor.opened

    @property
    def pid(self) -> int | None:
        """The id of the capture process, if there is one."""
        return None if self._supervisor is None else self._supervisor.pid

    # ------------------------------------------------------------------ the calibration board

    @asynccontextmanager
    async def open_images(self, stream: ImageStream) -> AsyncIterator[RealsenseImages]:
        """Deliver images of another stream, with the emitter off; depth is paused, and resumes afterwards.

        Raises:
            SourceError: the source is not open, or the stream does not start; depth then resumes, too.
        """
        depth = self._supervisor
        if depth is None:
            raise SourceError("the camera: expected an open source before images are read: call open first")
        await depth.pause()
        images = CaptureSupervisor(self._config.request(stream), self._board, "looking", self._command)
        images.begin()
        try:
            opened = await images.first_opened(self._config.open_timeout_s)
            yield RealsenseImages(image_info(opened), images)
        finally:
            await images.close()
            if self._supervisor is depth:
                depth.begin()

    def _joints_of(self, frame: SharedFrame) -> NDArray[np.float64] | None:
        """Return the joints of a frame.

        Raises:
            SourceError: there is no row for it.
        """
        if self._joints is None:
            return None
        row = frame.camera_number - 1
        if not 0 <= row < len(self._joints):
            raise SourceError(
                f"{self._config.joints_file}: expected a row for frame {frame.camera_number}, "
                f"got {len(self._joints)} rows"
            )
        joints: NDArray[np.float64] = self._joints[row]
        return joints


def camera_info(opened: link.Opened, fx_stereo: float | None = None) -> CameraInfo:
    """Return a depth camera's information.

    Raises:
        SourceError: its image is distorted, or is not of a depth camera.
    """
    intrinsics = _intrinsics(opened, fx_stereo)
    moved_px = distortion_px(intrinsics, np.array(opened.distortion))
    if moved_px > DISTORTION_MAX_PX:
        raise SourceError(
            f"camera {opened.serial}: expected depth without distortion, got {opened.distortion}, which moves pixels "
            f"by up to {moved_px:.3g}; let the camera deliver its own depth image, not one aligned to another lens"
        )
    return CameraInfo(opened.serial, opened.model, intrinsics)


def image_info(opened: link.Opened) -> ImageInfo:
    """Return an image stream's lens and its pose relative to depth.

    Raises:
        SourceError: it is not an image of a camera.
    """
    if opened.stream == "depth":
        raise SourceError(f"camera {opened.serial}: expected an image stream, got depth")
    T_depth_image = np.eye(4)
    T_depth_image[:3, :3] = np.reshape(opened.rotation, (3, 3))
    T_depth_image[:3, 3] = opened.translation_m
    k1, k2, p1, p2, k3 = opened.distortion
    return ImageInfo(
        opened.stream, _intrinsics(opened, None), (k1, k2, p1, p2, k3), opened.distortion_model, T_depth_image
    )


def _intrinsics(opened: link.Opened, fx_stereo: float | None) -> Intrinsics:
    try:
        return Intrinsics(
            width=opened.width,
            height=opened.height,
            fx=opened.fx,
            fy=opened.fy,
            cx=opened.cx,
            cy=opened.cy,
            # The SDK keeps it as float32; the true value is 0.001 m.
            depth_scale_m=float(str(np.float32(opened.depth_scale_m))),
            stereo_baseline_m=opened.stereo_baseline_m or D435_BASELINE_M,
            fx_stereo=fx_stereo,
        )
    except InputError as error:
        raise SourceError(f"camera {opened.serial}: {error}") from error


def _read_joints(path: Path) -> NDArray[np.float64]:
    """Read joint positions (frames, n)."""
    try:
        return parse_numbers(read_text(path))
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: expected a row of joint positions for each frame: {error}") from error
