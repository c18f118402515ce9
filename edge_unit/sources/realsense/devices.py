# SPDX-License-Identifier: Apache-2.0
"""Search for the configured camera among the RealSense SDK's devices. Blocking; for the capture process only.

A recording is loaded onto the SDK's context, and is then a device like any other.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edge_unit.sources.realsense.capture_link import Request
from edge_unit.sources.realsense.sdk import rs
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import SourceError

GONE_S = 3.0
RETURN_S = 10.0
"""After a reset a camera disappears within a second or two, and returns some 3 s later."""

LOOK_EVERY_S = 0.5
"""Time between two searches for an absent camera, since the SDK sometimes misses a hotplug event."""


class RecordingBroken(SourceError):
    """A recording that cannot be played; a new start would not help."""


class Unplugged(SourceError):
    """The camera was connected, and is no longer."""


class Devices:
    """Finds the device of a request on a context."""

    def __init__(self, context: rs.context, request: Request) -> None:
        self._context = context
        self._request = request
        self._device: Any = None
        self._recording: Any = None
        self._changed = threading.Event()
        self.removed = threading.Event()
        """Set when the device in use is unplugged."""
        context.set_devices_changed_callback(self._on_change)

    def find(self) -> tuple[Any, str]:
        """Return the device, or None and the reason for its absence in one sentence.

        Raises:
            RecordingBroken: the recording cannot be opened.
        """
        self._changed.clear()
        if self._request.recording:
            if self._recording is None:
                self._recording = self._load(self._request.recording)
            return self._recording, ""
        try:
            devices = {serial_of(device): device for device in self._context.query_devices()}
        except RuntimeError as error:
            # A device that is unplugged while the SDK lists it.
            return None, f"the list of cameras cannot be read: {error}"
        device, reason = _chosen(devices, self._request.serial)
        self._device = device
        return device, reason

    def wait(self, timeout_s: float = LOOK_EVERY_S) -> None:
        """Wait for a device to appear or disappear, at most `timeout_s`."""
        self._changed.wait(timeout_s)

    def reset(self, device: Any) -> Any:
        """Reset the hardware of `device`, and return the device that reappears.

        Raises:
            SourceError: no device reappeared.
        """
        self.removed.clear()
        device.hardware_reset()
        # Not every kernel reports the disappearance; then it must at least be present at the end.
        self.removed.wait(GONE_S)
        deadline_ns = monotonic_ns() + round(RETURN_S * NS_PER_S)
        while True:
            returned, reason = self.find()
            if returned is not None:
                self.removed.clear()
                return returned
            if monotonic_ns() > deadline_ns:
                raise SourceError(f"after a reset: {reason}; unplug it and plug it in again")
            self.wait()

    def _load(self, path: str) -> Any:
        if not Path(path).is_file():
            raise RecordingBroken(f"{path}: expected a recording, there is no such file")
        try:
            return self._context.load_device(path)
        except RuntimeError as error:
            why = str(error).rsplit(": ", 1)[-1]
            raise RecordingBroken(
                f"{path}: expected a recording that can be played; it may be truncated ({why})"
            ) from error

    def _on_change(self, info: rs.event_information) -> None:
        """Set flags only: this runs on a thread of the SDK."""
        if self._device is not None and info.was_removed(self._device):
            self.removed.set()
        self._changed.set()


def survey(context: rs.context) -> list[dict[str, Any]]:
    """Return the cameras on a context, each with its description for a person."""
    return [
        {
            "serial": serial_of(device),
            "model": info_of(device, rs.camera_info.name),
            "firmware": info_of(device, rs.camera_info.firmware_version),
            "recommended_firmware": info_of(device, rs.camera_info.recommended_firmware_version),
            "usb": info_of(device, rs.camera_info.usb_type_descriptor),
        }
        for device in context.query_devices()
    ]


def serial_of(device: Any) -> str:
    """Return a device's serial number; empty if it has none (in recovery mode)."""
    return info_of(device, rs.camera_info.serial_number)


def info_of(device: Any, what: rs.camera_info) -> str:
    """Return a device's own information; empty if it has none."""
    return str(device.get_info(what)) if device.supports(what) else ""


def profiles_of(device: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each sensor of a device with each of its stream profiles."""
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            yield sensor, profile


def _chosen(devices: dict[str, Any], wanted: str) -> tuple[Any, str]:
    """Return the configured device, or the only one; or None, and the reason."""
    there = ", ".join(serial or "one without a serial number" for serial in sorted(devices)) or "none"
    if wanted in devices:
        return devices[wanted], ""
    if wanted:
        return None, f"no RealSense camera {wanted} is connected (connected: {there})"
    if len(devices) > 1:
        return None, f"{len(devices)} RealSense cameras are connected ({there}); choose one by source.serial"
    if not devices:
        return None, "no RealSense camera is connected; check its cable, and the udev rules (edge-unit doctor)"
    return next(iter(devices.values())), ""
