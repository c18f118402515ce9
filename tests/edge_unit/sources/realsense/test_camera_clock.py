# SPDX-License-Identifier: Apache-2.0
"""The camera's clock against simulated ones that drift, jump, wrap and give wrong readings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from edge_unit.sources.realsense.camera_clock import LATENCY_MAX_NS, WRAP_NS, CameraClock
from shared.clock import NS_PER_MS, NS_PER_S, NS_PER_US

PERIOD_NS = NS_PER_S // 15
LATENCY_NS = 12 * NS_PER_MS
"""Of the simulated camera's fastest frame."""


@dataclass
class SimulatedCamera:
    """A clock with an offset and a drift, frames with a travel time, and a readable clock."""

    drift_ppm: float = 0.0
    zero_ns: int = 1000 * NS_PER_S
    """Our clock when the camera's was zero."""
    wraps: bool = False
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(7))

    def stamp(self, our_ns: int) -> int:
        camera_ns = round((our_ns - self.zero_ns) * (1.0 + self.drift_ppm * 1e-6)) // NS_PER_US * NS_PER_US
        return camera_ns % WRAP_NS if self.wraps else camera_ns

    def frames(self, from_ns: int, seconds: float) -> Iterator[tuple[int, int, int]]:
        """Return a frame's true capture time, its stamp, and its arrival: mostly soon, sometimes late."""
        for k in range(round(seconds * NS_PER_S / PERIOD_NS)):
            taken_ns = from_ns + k * PERIOD_NS
            under_way_ns = LATENCY_NS + round(self.random.exponential(4.0) * NS_PER_MS)
            yield taken_ns, self.stamp(taken_ns), taken_ns + under_way_ns

    def reading(self, our_ns: int, error_ns: int = 0) -> tuple[int, int, int]:
        """Return times before, of and after a reading: the answer takes 1 to 4 ms, and the reading lies in between."""
        there_ns, back_ns = (round(self.random.uniform(0.5, 2.0) * NS_PER_MS) for _ in range(2))
        return our_ns, self.stamp(our_ns + there_ns) + error_ns, our_ns + there_ns + back_ns


def errors_ms(clock: CameraClock, camera: SimulatedCamera, from_ns: int, seconds: float, ask: bool) -> list[float]:
    """Return the error of each frame's time."""
    errors, asked_ns = [], 0
    for taken_ns, stamp_ns, arrived_ns in camera.frames(from_ns, seconds):
        if ask and arrived_ns - asked_ns > NS_PER_S:
            clock.compare(*camera.reading(arrived_ns))
            asked_ns = arrived_ns
        captured_ns = clock.captured_at_ns(stamp_ns, arrived_ns)
        assert captured_ns <= arrived_ns
        errors.append((captured_ns - taken_ns) / NS_PER_MS)
    return errors


START_NS = 5000 * NS_PER_S


@pytest.mark.parametrize("drift_ppm", [-90.0, 0.0, 90.0])
def test_a_clock_that_can_be_read_is_followed(drift_ppm: float) -> None:
    clock, camera = CameraClock(0), SimulatedCamera(drift_ppm)
    errors = errors_ms(clock, camera, START_NS, 600.0, ask=True)
    assert clock.measured
    assert max(map(abs, errors)) < 1.5


@pytest.mark.parametrize("drift_ppm", [-90.0, 0.0, 90.0])
def test_without_it_the_fastest_frame_and_the_assumed_latency_decide(drift_ppm: float) -> None:
    clock, camera = CameraClock(LATENCY_NS), SimulatedCamera(drift_ppm)
    errors = errors_ms(clock, camera, START_NS, 600.0, ask=False)
    assert not clock.measured
    # One or two frames may come before a fast one.
    assert max(map(abs, errors[150:])) < 1.5
    assert max(errors) < 30.0


def test_the_counter_wraps_without_a_trace() -> None:
    camera = SimulatedCamera(drift_ppm=30.0, wraps=True)
    clock = CameraClock(0, wraps=True)
    before_wrap_ns = camera.zero_ns + WRAP_NS - 30 * NS_PER_S
    errors = errors_ms(clock, camera, before_wrap_ns, 60.0, ask=True)
    assert max(map(abs, errors)) < 1.5


def test_a_lying_reading_is_passed_over_and_two_that_agree_are_believed() -> None:
    clock, camera = CameraClock(0), SimulatedCamera()
    errors_ms(clock, camera, START_NS, 10.0, ask=True)
    clock.compare(*camera.reading(START_NS + 10 * NS_PER_S, error_ns=-2 * NS_PER_S))
    after_lie = errors_ms(clock, camera, START_NS + 10 * NS_PER_S, 0.9, ask=False)
    assert max(map(abs, after_lie)) < 1.5
    # The clock was set: every reading from now on says so, and so does every stamp.
    camera.zero_ns += 2 * NS_PER_S
    after_set = errors_ms(clock, camera, START_NS + 20 * NS_PER_S, 10.0, ask=True)
    assert max(map(abs, after_set[30:])) < 1.5


def test_readings_that_no_frame_bears_out_are_not_used() -> None:
    clock, camera = CameraClock(LATENCY_NS), SimulatedCamera()
    for second in range(5):
        clock.compare(*camera.reading(START_NS + second * NS_PER_S, error_ns=NS_PER_S))
    errors = errors_ms(clock, camera, START_NS + 5 * NS_PER_S, 20.0, ask=False)
    assert not clock.measured
    assert max(map(abs, errors[150:])) < 1.5


def test_a_camera_that_begins_anew_is_followed_at_once() -> None:
    clock, camera = CameraClock(LATENCY_NS), SimulatedCamera()
    errors_ms(clock, camera, START_NS, 20.0, ask=False)
    camera.zero_ns = START_NS + 20 * NS_PER_S
    errors = errors_ms(clock, camera, START_NS + 21 * NS_PER_S, 20.0, ask=False)
    assert max(errors) < 30.0
    assert max(map(abs, errors[150:])) < 1.5


def test_a_small_step_back_is_followed_within_seconds() -> None:
    clock, camera = CameraClock(LATENCY_NS), SimulatedCamera()
    errors_ms(clock, camera, START_NS, 20.0, ask=False)
    camera.zero_ns += 60 * NS_PER_MS
    errors = errors_ms(clock, camera, START_NS + 20 * NS_PER_S, 20.0, ask=False)
    # Too old at first, which is the safe side.
    assert max(errors) < 30.0
    assert max(map(abs, errors[120:])) < 1.5


def test_a_frame_that_was_held_up_is_as_old_as_it_is() -> None:
    clock, camera = CameraClock(LATENCY_NS), SimulatedCamera()
    errors_ms(clock, camera, START_NS, 20.0, ask=False)
    taken_ns = START_NS + 20 * NS_PER_S
    captured_ns = clock.captured_at_ns(camera.stamp(taken_ns), taken_ns + 3 * NS_PER_S)
    assert abs(captured_ns - taken_ns) < 1.5 * NS_PER_MS


def test_the_bound_on_the_latency_is_longer_than_a_frame_at_the_lowest_rate() -> None:
    assert LATENCY_MAX_NS > NS_PER_S / 6
