# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from edge_unit.daemon.frame_limiter import FrameLimiter
from edge_unit.daemon.unit_status import UnitStatus
from shared.clock import NS_PER_MS, NS_PER_S
from tests.set_clock import SetClock


def test_trouble_comes_before_frames_a_second_and_the_camera_s_first(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    clock = SetClock(0)
    status = UnitStatus(clock)
    clock.go_to(NS_PER_S)
    assert status.line(None) == "no frame yet"
    for _ in range(30):
        status.note_frame(None)
    clock.go_to(2 * NS_PER_S)
    assert status.line("camera: it is absent") == "camera: it is absent"
    for _ in range(15):
        status.note_frame(None)
    clock.go_to(3 * NS_PER_S)
    assert status.line(None) == "live, 15.0 fps"
    status.note_frame("joints: expected 6, got 5")
    assert status.line(None) == "joints: expected 6, got 5"
    assert caplog.messages == ["frames are filtered and reported", "joints: expected 6, got 5"]


@pytest.mark.parametrize(("fps_max", "expected"), [(None, 30), (15.0, 15), (10.0, 10), (30.0, 30)])
def test_frames_beyond_the_limit_are_passed_over(fps_max: float | None, expected: int) -> None:
    limiter = FrameLimiter(fps_max)
    jitter_ms = (0, 1, -1)
    times_ns = [n * NS_PER_S // 30 + jitter_ms[n % 3] * NS_PER_MS for n in range(30)]
    assert sum(limiter.due(at_ns + NS_PER_S) for at_ns in times_ns) == expected
