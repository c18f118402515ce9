# SPDX-License-Identifier: Apache-2.0
"""Capture time of an SDK frame by the unit's clock: passes the SDK's times to `CameraClock`."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from edge_unit.sources.realsense.camera_clock import CameraClock
from edge_unit.sources.realsense.sdk import rs
from shared.clock import NS_PER_MS, NS_PER_S, NS_PER_US, monotonic_ns, wall_ns

COMPARE_EVERY_NS = NS_PER_S
"""Clocks drift by less than 0.1 ms in the time between two readings of the camera's clock."""

EXPOSURE_MAX_US = 100_000
"""Time between the middle of the exposure and the read-out; a longer exposure value is invalid."""


class SdkClock:
    """The clock of one stream. `device` is read from time to time; None: a recording has no running clock."""

    def __init__(self, device: Any | None, latency_ns: int) -> None:
        self._device = device
        self._latency_ns = latency_ns
        self._clocks: dict[Any, CameraClock] = {}
        self._compared_ns = 0

    def captured_at_ns(self, frame: Any, arrived_ns: int) -> int:
        """Return the middle of the exposure of a frame that arrived at `arrived_ns`, CLOCK_MONOTONIC."""
        domain = frame.get_frame_timestamp_domain()
        if domain not in self._clocks:
            # The domain may change at run time: without metadata from the kernel the SDK stamps the arrival.
            wraps = domain == rs.timestamp_domain.hardware_clock
            self._clocks[domain] = CameraClock(self._latency_ns, wraps=wraps)
        clock = self._clocks[domain]
        if self._device is not None and arrived_ns - self._compared_ns >= COMPARE_EVERY_NS:
            self._compared_ns = arrived_ns
            self._compare(self._device, clock, domain)
        return clock.captured_at_ns(round(frame.get_timestamp() * NS_PER_MS), arrived_ns) - _exposure_ns(frame)

    def _compare(self, device: Any, clock: CameraClock, domain: Any) -> None:
        asked_ns = monotonic_ns()
        if domain == rs.timestamp_domain.global_time:
            clock.compare(asked_ns, wall_ns(), monotonic_ns())
        elif domain == rs.timestamp_domain.hardware_clock:
            # Some cameras have no readable clock; then the fastest frame decides.
            with suppress(RuntimeError):
                clock.compare(asked_ns, round(device.get_device_time_ms() * NS_PER_MS), monotonic_ns())


def _exposure_ns(frame: Any) -> int:
    """Return the time from the middle of the exposure to the stamp, which is of the read-out."""
    read_out, middle = rs.frame_metadata_value.frame_timestamp, rs.frame_metadata_value.sensor_timestamp
    if not (frame.supports_frame_metadata(read_out) and frame.supports_frame_metadata(middle)):
        return 0
    span_us = int(frame.get_frame_metadata(read_out)) - int(frame.get_frame_metadata(middle))
    return span_us * NS_PER_US if 0 <= span_us <= EXPOSURE_MAX_US else 0
