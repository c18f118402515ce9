# SPDX-License-Identifier: Apache-2.0
"""A live camera as the SDK's software device: the results of `SdkStream` and `Devices` with it, as JSON.

For a process of its own, so that the SDK is loaded nowhere else.
"""

from __future__ import annotations

import json
import os
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np

from edge_unit.sources.realsense.capture_link import Request
from edge_unit.sources.realsense.devices import Devices
from edge_unit.sources.realsense.sdk import rs
from edge_unit.sources.realsense.stream import SdkStream
from shared.clock import NS_PER_MS, monotonic_ns
from shared.errors import SourceError

USB_2_PROFILES = [(1280, 720, 6), (640, 480, 6), (640, 480, 15), (640, 480, 30), (480, 270, 60)]


class Camera:
    """A D435 at a USB 2 port."""

    def __init__(self) -> None:
        self.device = rs.software_device()
        for what, text in (
            (rs.camera_info.name, "Software D435"),
            (rs.camera_info.serial_number, "LIVE1"),
            (rs.camera_info.usb_type_descriptor, "2.1"),
        ):
            self.device.register_info(what, text)
        self.sensor = self.device.add_sensor("Stereo Module")
        self.sensor.add_read_only_option(rs.option.depth_units, 0.001)
        switch = rs.option_range()
        switch.min, switch.max, switch.step, switch.default = 0.0, 1.0, 1.0, 1.0
        for option in (rs.option.emitter_enabled, rs.option.global_time_enabled):
            self.sensor.add_option(option, switch, True)
        self.profiles: dict[Any, Any] = {}
        for uid, (width, height, fps) in enumerate(USB_2_PROFILES):
            for stream, index, kind, size in (
                (rs.stream.depth, 0, rs.format.z16, 2),
                (rs.stream.infrared, 1, rs.format.y8, 1),
            ):
                video = rs.video_stream()
                video.type, video.index, video.uid, video.fmt, video.bpp = stream, index, 2 * uid + index, kind, size
                video.width, video.height, video.fps = width, height, fps
                lens = rs.intrinsics()
                lens.width, lens.height, lens.fx, lens.fy = width, height, width / 2, width / 2
                lens.ppx, lens.ppy = width / 2, height / 2
                lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
                video.intrinsics = lens
                self.profiles[stream, width, fps] = self.sensor.add_video_stream(video)
        same_place = rs.extrinsics()
        same_place.rotation, same_place.translation = np.eye(3).ravel().tolist(), [0.0, 0.0, 0.0]
        depth = self.profiles[rs.stream.depth, 1280, 6]
        for (stream, _, _), profile in self.profiles.items():
            if stream == rs.stream.infrared:
                profile.register_extrinsics_to(depth, same_place)

    def show(self, number: int, stamp_ms: float) -> None:
        """Deliver a depth frame, exposed 4 ms before it was read out."""
        self.sensor.set_metadata(rs.frame_metadata_value.frame_timestamp, round(stamp_ms * 1000))
        self.sensor.set_metadata(rs.frame_metadata_value.sensor_timestamp, round(stamp_ms * 1000) - 4000)
        frame = rs.software_video_frame()
        frame.pixels = np.full((480, 640), number, np.uint16)
        frame.stride, frame.bpp, frame.timestamp, frame.frame_number = 1280, 2, stamp_ms, number
        frame.domain = rs.timestamp_domain.hardware_clock
        frame.profile = self.profiles[rs.stream.depth, 640, 15].as_video_stream_profile()
        self.sensor.on_video_frame(frame)

    def options(self) -> list[float]:
        return [self.sensor.get_option(each) for each in (rs.option.emitter_enabled, rs.option.global_time_enabled)]


def streams() -> dict[str, Any]:
    """Profiles, options and times of a live stream."""
    camera = Camera()
    # The state after an interrupted delivery of images of the board.
    camera.sensor.set_option(rs.option.emitter_enabled, 0.0)
    before = camera.options()
    stream = SdkStream(camera.device, Request(width=848, height=480, fps=15, latency_ns=20 * NS_PER_MS))
    opened = stream.start()
    depth_options = camera.options()
    readings = []
    for number in (1, 2, 2, 1, 5):
        sent_ns = monotonic_ns()
        camera.show(number, 5000.0 + 66.0 * number)
        reading = stream.read(2.0)
        if reading is not None:
            age_ms = (sent_ns - reading.captured_at_ns) / NS_PER_MS
            readings.append([reading.camera_number, int(reading.pixels[0, 0]), age_ms])
    silent = stream.read(0.05) is None
    stream.stop()
    camera = Camera()
    infrared = SdkStream(camera.device, Request(stream="infrared", width=848, height=480, fps=15))
    infrared_width = infrared.start().width
    infrared_options = camera.options()
    infrared.stop()
    try:
        SdkStream(Camera().device, Request(stream="color")).start()
        color = ""
    except SourceError as error:
        color = str(error)
    return {
        "profile": [opened.width, opened.height, opened.fps],
        "warning": opened.warning,
        "baseline_m": opened.stereo_baseline_m,
        "before": before,
        "depth_options": depth_options,
        "readings": readings,
        "silent": silent,
        "infrared_width": infrared_width,
        "infrared_options": infrared_options,
        "options_afterwards": camera.options(),
        "color": color,
    }


def busy() -> dict[str, Any]:
    """Check the errors of a camera that another program uses."""

    class Taken:
        def __init__(self, camera: Camera, text: str) -> None:
            self._camera, self._text = camera, text

        def __getattr__(self, name: str) -> Any:
            return getattr(self._camera.device, name)

        def query_sensors(self) -> Any:
            raise RuntimeError(self._text)

    told = {}
    for text in ("xioctl(VIDIOC_S_FMT) failed, errno=16 Last Error: Device or resource busy", "something else"):
        try:
            SdkStream(Taken(Camera(), text), Request()).start()
        except SourceError as error:
            told[text] = str(error)
    return told


def resets() -> dict[str, Any]:
    """Check a camera that disappears on a reset, and returns or does not."""

    class Context:
        def __init__(self) -> None:
            self.there = [Camera().device]
            self.callback: Any = None

        def set_devices_changed_callback(self, callback: Any) -> None:
            self.callback = callback

        def query_devices(self) -> list[Any]:
            return self.there

    told: dict[str, Any] = {}
    context = Context()
    devices = Devices(context, Request(serial="LIVE1"))
    device, reason = devices.find()
    told["found"] = [device is not None, reason]

    class Resettable:
        def hardware_reset(self) -> None:
            context.there = []
            context.callback(SimpleNamespace(was_removed=lambda _: True))
            context.there = [Camera().device]
            context.callback(SimpleNamespace(was_removed=lambda _: False))

    began_ns = monotonic_ns()
    told["returned"] = devices.reset(Resettable()) is not None
    told["reset_s"] = (monotonic_ns() - began_ns) / 1e9
    told["removed"] = devices.removed.is_set()
    context.callback(SimpleNamespace(was_removed=lambda _: True))
    told["unplugged"] = devices.removed.is_set()
    return told


if __name__ == "__main__":
    print(json.dumps({"streams": streams(), "busy": busy(), "resets": resets()}))
    sys.stdout.flush()
    # The SDK's destructors are known to abort.
    os._exit(0)
