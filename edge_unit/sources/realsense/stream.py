# SPDX-License-Identifier: Apache-2.0
"""One stream of one device of the RealSense SDK. Blocking; for the capture process only.

It uses the device's sensor, not the SDK's pipeline. The pipeline sometimes loses a frame at the start of a recording,
and halts for 10 s after a seek. Other behaviour of the SDK that its manual does not mention is described next to the
code that handles it.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_unit.sources.realsense.capture_link import Opened, Request
from edge_unit.sources.realsense.devices import RecordingBroken, info_of, profiles_of, serial_of
from edge_unit.sources.realsense.frame_clock import SdkClock
from edge_unit.sources.realsense.profiles import Profile, choose
from edge_unit.sources.realsense.sdk import rs
from shared.clock import NS_PER_S, NS_PER_US, monotonic_ns
from shared.errors import SourceEnded, SourceError

COLOR_SIZE = (1280, 720)
"""Image size for the board: large, for any size of the depth stream."""

READ_AHEAD_NS = 2 * NS_PER_S
"""Frames of a recording: more than the SDK's queues hold."""

BASELINE_RANGE_M = (0.005, 1.0)
"""Limits of the option `stereo_baseline`, in mm; some firmware reports 0."""


class Reading(NamedTuple):
    """One image, still owned by the SDK: `pixels` is valid until the next is read.

    `position_ns` is the read position of a recording at its arrival, which may be some frames further.
    """

    pixels: NDArray[Any]
    camera_number: int
    captured_at_ns: int
    position_ns: int


@dataclass(frozen=True)
class _Kind:
    """A stream in the SDK's terms; a negative index means any."""

    stream: rs.stream
    index: int
    format: rs.format
    channels: int


KINDS = {
    "depth": _Kind(rs.stream.depth, -1, rs.format.z16, 1),
    "infrared": _Kind(rs.stream.infrared, 1, rs.format.y8, 1),
    "color": _Kind(rs.stream.color, -1, rs.format.rgb8, 3),
}


class SdkStream:
    """Starts the stream of a request, and reads its images."""

    def __init__(self, device: Any, request: Request) -> None:
        self._device = device
        self._request = request
        self._kind = KINDS[request.stream]
        self._serial = serial_of(device)
        self._playback = device.as_playback() if device.is_playback() else None
        live = None if self._playback is not None else device
        self._clock = SdkClock(live, 0 if live is None else request.latency_ns)
        self._sensor: Any = None
        self._profile: Any = None
        self._condition = threading.Condition()
        self._waiting: tuple[Any, int] | None = None
        self._stopping = False
        self._ended = False
        self._reading: Any = None
        self._last_number = request.resume_after
        self._position_ns = 0

    # ------------------------------------------------------------------ starting and stopping

    def start(self) -> Opened:
        """Start; a recording resumes at the request's position.

        Raises:
            RecordingBroken: the recording has no such stream.
            SourceError: the camera is in use, or does not offer the stream.
        """
        try:
            self._sensor, self._profile = self._choose()
            opened = self._describe()
            if self._playback is None:
                self._set_options()
            else:
                self._prepare(self._playback)
            self._sensor.open(self._profile)
            self._sensor.start(self._on_frame)
        except RuntimeError as error:
            text = str(error)
            if "busy" in text.lower() or "set power state" in text:
                raise SourceError(
                    f"camera {self._serial} is in use by another program ({text}); stop that one (a service, a viewer)"
                ) from error
            raise SourceError(f"camera {self._serial} does not start: {text}") from error
        return opened

    def rewind(self) -> None:
        """Play an ended recording again."""
        self._sensor.stop()
        self._sensor.close()
        self._last_number = self._position_ns = 0
        with self._condition:
            self._waiting, self._ended = None, False
        # Only a newly opened sensor starts at the first frame again.
        self._sensor.open(self._profile)
        self._sensor.start(self._on_frame)

    def stop(self) -> None:
        """Stop, and leave the emitter on for the next user."""
        with self._condition:
            self._stopping = True
            self._condition.notify_all()
        with suppress(RuntimeError):
            if self._sensor is not None:
                self._sensor.stop()
                self._sensor.close()
            _set(self._device, rs.option.emitter_enabled, 1.0)

    def _choose(self) -> tuple[Any, Any]:
        """Return the sensor and the profile to run: the requested one, or the closest to it."""
        request = self._request
        offered = {_profile(found): (sensor, found) for sensor, found in profiles_of(self._device) if self._is(found)}
        size = COLOR_SIZE if request.stream == "color" else (request.width, request.height)
        chosen = choose(Profile(*size, request.fps), offered)
        if chosen is not None:
            return offered[chosen]
        what = f"no {request.stream} stream ({self._kind.format.name})"
        if self._playback is not None:
            raise RecordingBroken(f"{request.recording}: {what} was recorded")
        raise SourceError(f"camera {self._serial} offers {what}")

    def _is(self, profile: Any) -> bool:
        """Return True if this is a profile of the requested stream."""
        kind = self._kind
        return (
            profile.stream_type() == kind.stream
            and profile.format() == kind.format
            and (kind.index < 0 or profile.stream_index() == kind.index)
        )

    def _set_options(self) -> None:
        """Switch the emitter on for depth, off for images of the board; use time stamps of the camera's own clock."""
        _set(self._device, rs.option.emitter_enabled, 1.0 if self._request.stream == "depth" else 0.0)
        # Else the SDK maps them to the wall clock, which may be set at any time (with errors when the counter wraps).
        _set(self._device, rs.option.global_time_enabled, 0.0)

    def _prepare(self, playback: Any) -> None:
        """Play the recording from the request's position, at its own rate or at the reader's."""
        playback.set_status_changed_callback(self._on_status)
        playback.set_real_time(not self._request.lockstep)
        if self._last_number:
            # The SDK reads ahead of its deliveries; if no frame may be missing, seek back further than that.
            margin_ns = READ_AHEAD_NS if self._request.lockstep else 0
            playback.seek(timedelta(microseconds=max(self._request.resume_at_ns - margin_ns, 0) // NS_PER_US))

    # ------------------------------------------------------------------ its properties

    def _describe(self) -> Opened:
        device, chosen = self._device, _profile(self._profile)
        lens = self._profile.as_video_stream_profile().intrinsics
        depth_sensor = device.first_depth_sensor()
        rotation, translation = np.eye(3), [0.0, 0.0, 0.0]
        if self._request.stream != "depth":
            depth = next(found for _, found in profiles_of(device) if found.stream_type() == rs.stream.depth)
            to_depth = self._profile.get_extrinsics_to(depth)
            # The SDK stores matrices by columns.
            rotation, translation = np.reshape(to_depth.rotation, (3, 3)).T, list(to_depth.translation)
        baseline_m = 0.0
        if depth_sensor.supports(rs.option.stereo_baseline):
            told_m = abs(depth_sensor.get_option(rs.option.stereo_baseline)) / 1000.0
            baseline_m = told_m if BASELINE_RANGE_M[0] <= told_m <= BASELINE_RANGE_M[1] else 0.0
        return Opened(
            stream=self._request.stream,
            serial=self._serial,
            model=info_of(device, rs.camera_info.name),
            firmware=info_of(device, rs.camera_info.firmware_version),
            usb=info_of(device, rs.camera_info.usb_type_descriptor),
            warning=self._warning(chosen),
            width=lens.width,
            height=lens.height,
            channels=self._kind.channels,
            fps=chosen.fps,
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

    def _warning(self, chosen: Profile) -> str:
        """Return the defects of the stream with their remedies."""
        request, parts = self._request, []
        usb = info_of(self._device, rs.camera_info.usb_type_descriptor)
        if usb.startswith(("1", "2")):
            parts.append(f"the camera is at a USB {usb} port or cable; use a USB 3 port and its cable")
        wanted = Profile(request.width, request.height, request.fps)
        if request.stream != "color" and chosen != wanted and self._playback is None:
            parts.append(f"{wanted} is not offered, running {chosen}")
        return "; ".join(parts)

    # ------------------------------------------------------------------ reading

    def read(self, timeout_s: float) -> Reading | None:
        """Return the next image, or None if none came in time. Images seen before are skipped.

        Raises:
            SourceEnded: the recording has ended.
        """
        with self._condition:
            if self._waiting is None and not self._ended:
                self._condition.wait(timeout_s)
            waiting, self._waiting = self._waiting, None
            self._condition.notify_all()
            if waiting is None:
                if self._ended:
                    raise SourceEnded(f"{self._request.recording} is at its end")
                return None
        frame, arrived_ns = waiting
        if frame.get_frame_number() <= self._last_number:
            return None
        self._reading = frame
        self._last_number = frame.get_frame_number()
        if self._playback is not None:
            # It jumps back to 0 after reading the last frame, perhaps before that frame is delivered.
            self._position_ns = max(self._position_ns, self._playback.get_position())
        # If a recording does not play at its own rate, its stamps are useless; the time of delivery counts.
        captured_at_ns = arrived_ns if self._request.lockstep else self._clock.captured_at_ns(frame, arrived_ns)
        return Reading(np.asanyarray(frame.get_data()), self._last_number, captured_at_ns, self._position_ns)

    @property
    def left_out_s(self) -> float:
        """Return the length of a recording that was not played although it ended."""
        if self._playback is None:
            return 0.0
        return float(self._playback.get_duration().total_seconds() - self._position_ns / NS_PER_S)

    def _on_frame(self, frame: Any) -> None:
        """Run on a thread of the SDK: store the frame for `read`; in lockstep wait until the last one was read."""
        arrived_ns = monotonic_ns()
        with self._condition:
            while self._request.lockstep and self._waiting is not None and not self._stopping:
                self._condition.wait()
            self._waiting = frame, arrived_ns
            self._condition.notify_all()

    def _on_status(self, status: rs.playback_status) -> None:
        """Run on a thread of the SDK. Only this callback signals the end of a recording at once."""
        if status == rs.playback_status.stopped:
            with self._condition:
                self._ended = True
                self._condition.notify_all()


def _profile(found: Any) -> Profile:
    video = found.as_video_stream_profile()
    return Profile(video.width(), video.height(), video.fps())


def _set(device: Any, option: rs.option, value: float) -> None:
    """Set an option on each sensor that has it; a camera without it is left alone."""
    for sensor in device.query_sensors():
        if sensor.supports(option) and not sensor.is_option_read_only(option):
            sensor.set_option(option, value)
