# SPDX-License-Identifier: Apache-2.0
"""One camera, or one recording of a camera, as the RealSense SDK sees it. Blocking; for the capture process alone.

A recording is loaded onto the SDK's context, where it is a device like any other: found, started and lost by the same
code. What the SDK does that its manual does not tell is written where it is dealt with.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyrealsense2 as rs
from numpy.typing import NDArray

from edge_unit.sources.camera_clock import CameraClock
from edge_unit.sources.capture_link import Opened, Request
from edge_unit.sources.profiles import Profile, choose
from shared.clock import NS_PER_MS, NS_PER_S, NS_PER_US, monotonic_ns, wall_ns
from shared.errors import SourceEnded, SourceError

COLOR_PROFILE = (1280, 720)
"""For the board the picture is wanted large, whatever the depth stream's size."""

EXPOSURE_MAX_US = 100_000
"""Between the middle of the exposure and the read-out; what is more is no exposure."""

COMPARE_EVERY_NS = NS_PER_S
"""Clocks drift by less than 0.1 ms in the time between two readings of the camera's clock."""

READ_AHEAD_NS = 2 * NS_PER_S
"""Of a recording: more than the SDK's queues hold."""

RETURN_MS = 10_000
"""After a reset a camera is gone for some 3 s."""

BASELINE_RANGE_M = (0.005, 1.0)
"""Of what the option `stereo_baseline` tells, in mm; some firmware tells 0."""


class Reading(NamedTuple):
    """One image, still in the SDK's hands: `pixels` is valid until the next is read.

    `position_ns` is how far a recording was read when it came, which may be some frames further.
    """

    pixels: NDArray[Any]
    camera_number: int
    captured_at_ns: int
    position_ns: int


class RecordingBroken(SourceError):
    """A recording that cannot be played; to begin anew would not help."""


@dataclass(frozen=True)
class _Stream:
    """What belongs to the asked stream in the SDK's words."""

    kind: rs.stream
    index: int
    format: rs.format
    channels: int
    sizes_follow_request: bool


STREAMS = {
    "depth": _Stream(rs.stream.depth, -1, rs.format.z16, 1, True),
    "infrared": _Stream(rs.stream.infrared, 1, rs.format.y8, 1, True),
    "color": _Stream(rs.stream.color, -1, rs.format.rgb8, 3, False),
}


class SdkCamera:
    """Finds a camera, starts one stream of it, and reads frames."""

    def __init__(self, context: rs.context, request: Request) -> None:
        self._context = context
        self._request = request
        self._stream = STREAMS[request.stream]
        self._device: Any = None
        self._loaded: Any = None
        self._pipeline: Any = None
        self._playback: Any = None
        self._ended = threading.Event()
        self._clocks: dict[Any, CameraClock] = {}
        self._compared_ns = 0
        self._last_number = request.resume_after
        self._position_ns = 0
        self.changed = threading.Event()
        """Set whenever a device came or went."""
        self.removed = threading.Event()
        """Set when the device in use was unplugged."""
        context.set_devices_changed_callback(self._devices_changed)

    # ------------------------------------------------------------------ finding

    def find(self) -> str | None:
        """Look for the camera; None when it is there, else why not, in one sentence.

        Raises:
            RecordingBroken: the recording cannot be opened.
        """
        if self._request.recording and self._loaded is None:
            self._loaded = self._load(self._request.recording)
        try:
            devices = {serial_of(device): device for device in self._context.query_devices()}
        except RuntimeError as error:
            # A device that goes while the SDK lists it.
            return f"the list of cameras cannot be read: {error}"
        wanted = serial_of(self._loaded) if self._loaded is not None else self._request.serial
        there = ", ".join(serial or "one without a serial number" for serial in sorted(devices)) or "none"
        if wanted:
            self._device = devices.get(wanted)
            if self._device is None:
                return f"no RealSense camera {wanted} is connected (there is {there})"
        elif len(devices) > 1:
            return f"{len(devices)} RealSense cameras are connected ({there}); choose one by source.serial"
        else:
            self._device = next(iter(devices.values()), None)
            if self._device is None:
                return "no RealSense camera is connected; check its cable, and the udev rules (edge-unit doctor)"
        return None

    def reset(self) -> None:
        """Reset the camera's hardware, and wait until it is back.

        Raises:
            SourceError: it did not come back.
        """
        self.changed.clear()
        self.removed.clear()
        self._device.hardware_reset()
        # Not every kernel tells when it goes; then it must at least be there at the end.
        self.removed.wait(RETURN_MS / 1000 / 2)
        deadline_ns = monotonic_ns() + RETURN_MS * NS_PER_MS
        while (reason := self.find()) is not None:
            left_ns = deadline_ns - monotonic_ns()
            if left_ns <= 0:
                raise SourceError(f"after a reset: {reason}; unplug it and plug it in again")
            self.changed.wait(min(left_ns / NS_PER_S, 0.5))
            self.changed.clear()
        self.removed.clear()

    def _load(self, path: str) -> Any:
        if not Path(path).is_file():
            raise RecordingBroken(f"{path}: there is no such recording")
        try:
            return self._context.load_device(path)
        except RuntimeError as error:
            raise RecordingBroken(
                f"{path}: no recording that can be played; it may have been cut short ({error})"
            ) from error

    def _devices_changed(self, info: rs.event_information) -> None:
        """On a thread of the SDK: only raises flags."""
        if self._device is not None and info.was_removed(self._device):
            self.removed.set()
        self.changed.set()

    # ------------------------------------------------------------------ starting and stopping

    def start(self) -> Opened:
        """Start the stream; a recording goes on where the request wants it to.

        Raises:
            RecordingBroken: the recording has no such stream.
            SourceError: the camera is in use, or does not offer it.
        """
        serial = serial_of(self._device)
        try:
            return self._start(serial)
        except RuntimeError as error:
            text = str(error)
            if "busy" in text.lower() or "set power state" in text:
                raise SourceError(
                    f"camera {serial} is in use by another program ({text}); stop that one (a service, a viewer)"
                ) from error
            raise SourceError(f"camera {serial} does not start: {text}") from error

    def _start(self, serial: str) -> Opened:
        device, stream = self._device, self._stream
        chosen = self._choose(device)
        config = rs.config()
        config.enable_device(serial)
        if device.is_playback():
            config.enable_stream(stream.kind, stream.index)
        else:
            config.enable_stream(stream.kind, stream.index, chosen.width, chosen.height, stream.format, chosen.fps)
            self._set_options(device)
        self._pipeline = rs.pipeline(self._context)
        active = self._pipeline.start(config)
        if device.is_playback():
            self._play(active.get_device().as_playback())
        return self._describe(device, active.get_stream(stream.kind, stream.index), chosen)

    def _play(self, playback: Any) -> None:
        """Play the recording from where it was left, at its own pace or at ours."""
        ended = self._ended = threading.Event()

        def changed(status: rs.playback_status) -> None:
            """On a thread of the SDK. Only this tells the end at once; a timeout alone could be a slow disk."""
            if status == rs.playback_status.stopped:
                ended.set()

        playback.set_status_changed_callback(changed)
        playback.set_real_time(not self._request.lockstep)
        if self._last_number:
            # The SDK reads ahead of what it delivers; where no frame may be missing, go back further than that.
            margin_ns = READ_AHEAD_NS if self._request.lockstep else 0
            playback.seek(timedelta(microseconds=max(self._request.resume_at_ns - margin_ns, 0) // NS_PER_US))
        self._playback = playback

    def stop(self) -> None:
        """Stop the stream, and leave the emitter on for whoever is next."""
        with suppress(RuntimeError):
            if self._pipeline is not None:
                self._pipeline.stop()
            if self._device is not None:
                _set(self._device, rs.option.emitter_enabled, 1.0)

    def rewind(self) -> None:
        """Begin a recording again."""
        self._pipeline.stop()
        self._last_number = self._position_ns = 0
        self.start()

    def _choose(self, device: Any) -> Profile:
        """The profile to run: as asked for, or what comes nearest to it."""
        request, stream = self._request, self._stream
        offered = [
            Profile(video.width(), video.height(), video.fps())
            for profile in _profiles(device)
            if profile.stream_type() == stream.kind
            and profile.format() == stream.format
            and (stream.index < 0 or profile.stream_index() == stream.index)
            for video in (profile.as_video_stream_profile(),)
        ]
        size = (request.width, request.height) if stream.sizes_follow_request else COLOR_PROFILE
        chosen = choose(Profile(*size, request.fps), offered)
        if chosen is None:
            what = f"no {request.stream} stream ({stream.format.name})"
            if device.is_playback():
                raise RecordingBroken(f"{request.recording}: {what} was recorded")
            raise SourceError(f"camera {serial_of(device)} offers {what}")
        return chosen

    def _set_options(self, device: Any) -> None:
        """Emitter on for depth, off for pictures of the board; time stamps by the camera's own clock."""
        _set(device, rs.option.emitter_enabled, 1.0 if self._request.stream == "depth" else 0.0)
        # Else the SDK maps them to the wall clock, which may be set at any time (and it errs when the counter wraps).
        _set(device, rs.option.global_time_enabled, 0.0)

    def _describe(self, device: Any, profile: Any, chosen: Profile) -> Opened:
        video = profile.as_video_stream_profile()
        lens = video.intrinsics
        depth_sensor = device.first_depth_sensor()
        depth = next(each for each in _profiles(device) if each.stream_type() == rs.stream.depth)
        rotation, translation = np.eye(3), [0.0, 0.0, 0.0]
        if self._request.stream != "depth":
            to_depth = profile.get_extrinsics_to(depth)
            # The SDK stores matrices by columns.
            rotation, translation = np.reshape(to_depth.rotation, (3, 3)).T, list(to_depth.translation)
        baseline_m = 0.0
        if depth_sensor.supports(rs.option.stereo_baseline):
            told_m = abs(depth_sensor.get_option(rs.option.stereo_baseline)) / 1000.0
            baseline_m = told_m if BASELINE_RANGE_M[0] <= told_m <= BASELINE_RANGE_M[1] else 0.0
        return Opened(
            stream=self._request.stream,
            serial=serial_of(device),
            model=info_of(device, rs.camera_info.name),
            firmware=info_of(device, rs.camera_info.firmware_version),
            usb=info_of(device, rs.camera_info.usb_type_descriptor),
            warning=self._warning(device, chosen),
            width=lens.width,
            height=lens.height,
            channels=self._stream.channels,
            fps=video.fps(),
            fx=lens.fx,
            fy=lens.fy,
            cx=lens.ppx,
            cy=lens.ppy,
            distortion_model=lens.model.name,
            distortion=list(lens.coeffs),
            rotation=rotation.ravel().tolist(),
            translation_m=translation,
            depth_scale_m=depth_sensor.get_depth_scale(),
            stereo_baseline_m=baseline_m,
        )

    def _warning(self, device: Any, chosen: Profile) -> str:
        """What is worse than it need be, and what to do about it."""
        request, parts = self._request, []
        usb = info_of(device, rs.camera_info.usb_type_descriptor)
        if usb.startswith(("1", "2")):
            parts.append(f"the camera is at a USB {usb} port or cable; use a USB 3 port and its cable")
        wanted = Profile(request.width, request.height, request.fps)
        if self._stream.sizes_follow_request and chosen != wanted and not device.is_playback():
            parts.append(f"{wanted} is not offered, running {chosen}")
        return "; ".join(parts)

    # ------------------------------------------------------------------ reading

    def read(self, timeout_ms: int) -> Reading | None:
        """The next image, or None when none came in time. What was seen already is passed over.

        Raises:
            SourceEnded: the recording has come to its end.
            SourceError: the camera was unplugged.
        """
        ended = self._ended.is_set()
        if self.removed.is_set():
            raise SourceError(f"camera {serial_of(self._device)} was unplugged")
        # Never start() with a callback: a recording stalls there after two frames when it is not played in real time.
        came, frames = self._pipeline.try_wait_for_frames(timeout_ms)
        if not came:
            if ended:
                raise SourceEnded(f"{self._request.recording} is at its end")
            return None
        arrived_ns = monotonic_ns()
        # With two streams, a set may hold one image anew and the other for the second time; with one, after a rewind.
        frame = frames.first_or_default(self._stream.kind, self._stream.format)
        if not frame or frame.get_frame_number() <= self._last_number:
            return None
        self._last_number = frame.get_frame_number()
        captured_at_ns = self._captured_at_ns(frame, arrived_ns)
        if self._playback is not None:
            # It jumps back to 0 when the last frame was read, which may be before that frame is delivered.
            self._position_ns = max(self._position_ns, self._playback.get_position())
        return Reading(np.asanyarray(frame.get_data()), self._last_number, captured_at_ns, self._position_ns)

    @property
    def left_out_s(self) -> float:
        """How much of a recording was not played although it has ended."""
        return float(self._playback.get_duration().total_seconds() - self._position_ns / NS_PER_S)

    def _captured_at_ns(self, frame: Any, arrived_ns: int) -> int:
        """Middle of the exposure by our clock; the delivery, where a recording is not played at its own pace."""
        if self._request.lockstep:
            return arrived_ns
        domain = frame.get_frame_timestamp_domain()
        if domain not in self._clocks:
            # The SDK falls back to the time of arrival when the kernel passes no metadata on.
            latency_ns = 0 if self._request.recording else self._request.latency_ns
            self._clocks[domain] = CameraClock(latency_ns, wraps=domain == rs.timestamp_domain.hardware_clock)
        clock = self._clocks[domain]
        self._compare(clock, domain, arrived_ns)
        captured_at_ns = clock.captured_at_ns(round(frame.get_timestamp() * NS_PER_MS), arrived_ns)
        return captured_at_ns - self._exposure_ns(frame)

    def _compare(self, clock: CameraClock, domain: Any, now_ns: int) -> None:
        """Read the camera's clock now and then; no recording has one that runs."""
        if self._request.recording or now_ns - self._compared_ns < COMPARE_EVERY_NS:
            return
        self._compared_ns = now_ns
        if domain == rs.timestamp_domain.global_time:
            asked_ns = monotonic_ns()
            clock.compare(asked_ns, wall_ns(), monotonic_ns())
        elif domain == rs.timestamp_domain.hardware_clock:
            with suppress(RuntimeError):
                asked_ns = monotonic_ns()
                camera_ms = self._device.get_device_time_ms()
                clock.compare(asked_ns, round(camera_ms * NS_PER_MS), monotonic_ns())

    def _exposure_ns(self, frame: Any) -> int:
        """From the middle of the exposure to the stamp, which is of the read-out."""
        read_out, middle = rs.frame_metadata_value.frame_timestamp, rs.frame_metadata_value.sensor_timestamp
        if not (frame.supports_frame_metadata(read_out) and frame.supports_frame_metadata(middle)):
            return 0
        span_us = frame.get_frame_metadata(read_out) - frame.get_frame_metadata(middle)
        return int(span_us) * NS_PER_US if 0 <= span_us <= EXPOSURE_MAX_US else 0


def survey(context: rs.context) -> list[dict[str, Any]]:
    """The cameras on a context, each with what a person wants to know of it."""
    return [
        {
            "serial": serial_of(device),
            "model": info_of(device, rs.camera_info.name),
            "firmware": info_of(device, rs.camera_info.firmware_version),
            "recommended_firmware": info_of(device, rs.camera_info.recommended_firmware_version),
            "usb": info_of(device, rs.camera_info.usb_type_descriptor),
            "depth_profiles": sorted(
                {
                    (video.width(), video.height(), video.fps())
                    for profile in _profiles(device)
                    if profile.stream_type() == rs.stream.depth and profile.format() == rs.format.z16
                    for video in (profile.as_video_stream_profile(),)
                }
            ),
        }
        for device in context.query_devices()
    ]


def serial_of(device: Any) -> str:
    """A device's serial number; empty where it has none (in recovery mode)."""
    return info_of(device, rs.camera_info.serial_number)


def info_of(device: Any, what: rs.camera_info) -> str:
    """What a device tells of itself; empty where it tells nothing."""
    return str(device.get_info(what)) if device.supports(what) else ""


def _profiles(device: Any) -> Iterator[Any]:
    for sensor in device.query_sensors():
        yield from sensor.get_stream_profiles()


def _set(device: Any, option: rs.option, value: float) -> None:
    """Set an option wherever it can be set; a camera without it has nothing to be set."""
    for sensor in device.query_sensors():
        if sensor.supports(option) and not sensor.is_option_read_only(option):
            sensor.set_option(option, value)
