# SPDX-License-Identifier: Apache-2.0
"""Writes recordings in the format of the RealSense SDK, from images that did not come from a camera.

The SDK's software device plays the camera, and its own recorder writes the file. Run it in a process of its own, since
the SDK may crash its process at the end.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_unit.sources.realsense.capture_link import Stream
from edge_unit.sources.realsense.sdk import rs
from shared.errors import SourceError

SUFFIX = ".db3"
"""The only file format that today's SDK writes; it still plays the older `.bag`."""

WRITE_MS = 5_000
"""Time for one image to pass through the recorder."""

FORMATS = {
    "depth": (rs.stream.depth, 0, rs.format.z16, 2),
    "infrared": (rs.stream.infrared, 1, rs.format.y8, 1),
    "color": (rs.stream.color, 0, rs.format.rgb8, 3),
}


@dataclass(frozen=True)
class RecordedStream:
    """One stream of the camera; `stands_at_m` is its origin in the depth camera's frame, with the same orientation."""

    stream: Stream
    width: int
    height: int
    fps: int
    fx: float
    fy: float
    cx: float
    cy: float
    stands_at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RecordedCamera:
    """The identity and the constants of the camera."""

    serial: str
    model: str
    depth_scale_m: float = 0.001
    stereo_baseline_m: float = 0.05
    firmware: str = ""
    usb: str = ""


class SdkRecorder:
    """A recording that is being written; complete only after `close`."""

    def __init__(self, path: Path, camera: RecordedCamera, streams: Sequence[RecordedStream]) -> None:
        """Start the file `path`; an existing one is replaced. The first stream must be depth.

        Raises:
            SourceError: it cannot be written; the text names it.
        """
        if path.suffix != SUFFIX:
            raise SourceError(f"{path}: expected a name that ends in {SUFFIX}, the only kind that the SDK writes")
        device = rs.software_device()
        for what, text in (
            (rs.camera_info.name, camera.model),
            (rs.camera_info.serial_number, camera.serial),
            (rs.camera_info.firmware_version, camera.firmware),
            (rs.camera_info.usb_type_descriptor, camera.usb),
            (rs.camera_info.product_line, "D400"),
        ):
            if text:
                device.register_info(what, text)
        self._sensor = device.add_sensor("Stereo Module")
        # Without this option the scale is missing in the file, even though the frames have it.
        self._sensor.add_read_only_option(rs.option.depth_units, camera.depth_scale_m)
        self._sensor.add_read_only_option(rs.option.stereo_baseline, 1000.0 * camera.stereo_baseline_m)
        self._depth_scale_m = camera.depth_scale_m
        self._profiles = {each.stream: self._add(each, uid) for uid, each in enumerate(streams, 1)}
        for each in streams[1:]:
            self._profiles["depth"].register_extrinsics_to(self._profiles[each.stream], _away(each.stands_at_m))
        try:
            path.unlink(missing_ok=True)
            self._recorder: Any = rs.recorder(str(path), device)
        except (OSError, RuntimeError) as error:
            raise SourceError(f"{path}: cannot be written: {error}") from error
        self._device: Any = device
        self._queue = rs.frame_queue(8, keep_frames=True)
        self._recorded: Any = self._recorder.query_sensors()[0]
        self._recorded.open(self._recorded.get_stream_profiles())
        self._recorded.start(self._queue)

    def add(self, stream: Stream, pixels: NDArray[Any], number: int, timestamp_ms: float) -> None:
        """Append an image: uint16 for depth, uint8 (H, W) for infrared, uint8 (H, W, 3) RGB for colour.

        Raises:
            SourceError: the recorder did not accept it.
        """
        frame = rs.software_video_frame()
        frame.pixels = np.ascontiguousarray(pixels)
        frame.bpp = FORMATS[stream][3]
        frame.stride = pixels.shape[1] * frame.bpp
        frame.timestamp = timestamp_ms
        frame.domain = rs.timestamp_domain.hardware_clock
        frame.frame_number = number
        frame.profile = self._profiles[stream].as_video_stream_profile()
        if stream == "depth":
            frame.depth_units = self._depth_scale_m
        self._sensor.on_video_frame(frame)
        came, _ = self._queue.try_wait_for_frame(WRITE_MS)
        if not came:
            raise SourceError(f"the recorder did not take frame {number} within {WRITE_MS / 1000:g} s")

    def close(self) -> None:
        """Complete the file."""
        self._recorded.stop()
        self._recorded.close()
        # The file is complete only after the SDK's last reference to it is gone.
        self._recorded = self._recorder = self._device = None
        gc.collect()

    def _add(self, each: RecordedStream, uid: int) -> Any:
        kind, index, pixel_format, bytes_per_pixel = FORMATS[each.stream]
        lens = rs.intrinsics()
        lens.width, lens.height = each.width, each.height
        lens.fx, lens.fy, lens.ppx, lens.ppy = each.fx, each.fy, each.cx, each.cy
        lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
        video = rs.video_stream()
        video.type, video.index, video.uid, video.fmt = kind, index, uid, pixel_format
        video.width, video.height, video.fps, video.bpp = each.width, each.height, each.fps, bytes_per_pixel
        video.intrinsics = lens
        return self._sensor.add_video_stream(video, each.stream == "depth")


def _away(stands_at_m: tuple[float, float, float]) -> rs.extrinsics:
    """Return the map from the depth camera's frame to the frame of a stream at that position."""
    to_stream = rs.extrinsics()
    to_stream.rotation = np.eye(3).ravel().tolist()
    to_stream.translation = [-value for value in stands_at_m]
    return to_stream
