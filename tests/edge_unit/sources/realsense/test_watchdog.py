# SPDX-License-Identifier: Apache-2.0
"""The watchdog's decisions, without a process and without waiting."""

from __future__ import annotations

import pytest

from edge_unit.sources.realsense.capture_link import PhaseName
from edge_unit.sources.realsense.watchdog import BACK_OFF_S, PATIENCE_S, STEADY_NS, Watchdog
from shared.clock import NS_PER_MS, NS_PER_S

START_NS = 77 * NS_PER_S


def streaming(fps: int = 15) -> Watchdog:
    watchdog = Watchdog()
    watchdog.begin(START_NS)
    watchdog.note_message(START_NS, "starting")
    watchdog.stream(START_NS, fps)
    return watchdog


@pytest.mark.parametrize("phase", PATIENCE_S)
def test_each_phase_has_its_own_patience(phase: PhaseName) -> None:
    watchdog = Watchdog()
    watchdog.begin(START_NS)
    watchdog.note_message(START_NS, phase)
    patience_ns = round(PATIENCE_S[watchdog.phase] * NS_PER_S)
    assert watchdog.stuck_s(START_NS + patience_ns) is None
    assert watchdog.stuck_s(START_NS + patience_ns + NS_PER_MS) == pytest.approx(PATIENCE_S[watchdog.phase], abs=0.002)
    watchdog.note_message(START_NS + patience_ns)
    assert watchdog.stuck_s(START_NS + patience_ns + NS_PER_MS) is None


@pytest.mark.parametrize("fps", [6, 15, 30, 90])
def test_silence_is_reported_well_within_a_second_and_never_between_two_frames(fps: int) -> None:
    watchdog = streaming(fps)
    assert watchdog.silent_s(START_NS + 2 * NS_PER_S // fps) is None
    assert watchdog.silent_s(START_NS + 700 * NS_PER_MS) == pytest.approx(0.7)
    watchdog.frame(START_NS + 700 * NS_PER_MS)
    assert watchdog.silent_s(START_NS + 710 * NS_PER_MS) is None


def test_nobody_is_silent_before_the_stream_began() -> None:
    watchdog = Watchdog()
    watchdog.begin(START_NS)
    assert watchdog.silent_s(START_NS + 100 * NS_PER_S) is None


def test_the_first_restart_is_at_once_the_next_ones_later_and_a_reset_is_tried_every_second_time() -> None:
    watchdog = streaming()
    restarts = []
    for _ in range(8):
        restarts.append(watchdog.end())
        watchdog.begin(START_NS)
        watchdog.note_message(START_NS, "starting")
    assert tuple(restart.delay_s for restart in restarts) == BACK_OFF_S + BACK_OFF_S[-1:] * 2
    assert [restart.reset for restart in restarts] == [False, True] * 4


def test_a_camera_that_was_never_found_is_not_reset() -> None:
    watchdog = Watchdog()
    for _ in range(4):
        watchdog.begin(START_NS)
        watchdog.note_message(START_NS, "waiting")
        assert not watchdog.end().reset


def test_a_steady_stream_wipes_the_slate() -> None:
    watchdog = streaming()
    for _ in range(3):
        watchdog.end()
    watchdog.begin(START_NS)
    watchdog.stream(START_NS, 15)
    watchdog.frame(START_NS + STEADY_NS)
    restart = watchdog.end()
    assert (restart.delay_s, restart.reset) == (0.0, False)


def test_an_unplugged_camera_is_no_failure() -> None:
    watchdog = streaming()
    for _ in range(5):
        restart = watchdog.end(unplugged=True)
        assert (restart.delay_s, restart.reset) == (0.0, False)
    assert watchdog.end().delay_s == 0.0
