# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from edge_unit.joints import JointEstimate, JointHistory
from edge_unit.joints.history import (
    ACCELERATION_MAX,
    CAPTURE_UNCERTAINTY_NS,
    EXTRAPOLATION_MAX_S,
    HISTORY_SAMPLES,
    UNCERTAINTY_MAX,
)
from shared.messages import JointSample

MS = 1_000_000
S = 1_000_000_000
STALE_S = 0.5


def history(*samples: tuple[float, float], velocity: float | None = None) -> JointHistory:
    """Samples of one joint: (time in ms, position)."""
    made = JointHistory()
    velocities = None if velocity is None else (velocity,)
    made.add(JointSample(round(at_ms * MS), (position,), velocities) for at_ms, position in samples)
    return made


def at(known: JointHistory, at_ms: float, clock_ms: float = 0.0, stale_after_s: float = STALE_S) -> JointEstimate:
    found = known.at(round(at_ms * MS), round(clock_ms * MS), stale_after_s)
    assert found is not None
    return found


def test_between_samples_it_interpolates() -> None:
    found = at(history((1000, 0.0), (1010, 0.01), (1020, 0.03)), 1015)
    assert found.positions == pytest.approx([0.02])
    # 2 rad/s over the uncertainty of the capture's time.
    assert found.uncertainty == pytest.approx([2.0 * CAPTURE_UNCERTAINTY_NS / S], rel=0.05)


def test_the_uncertainty_of_the_clock_counts_by_speed() -> None:
    found = at(history((1000, 0.0), (1010, 0.01)), 1005, clock_ms=20.0)
    assert found.uncertainty == pytest.approx([0.022], rel=0.02)


def test_a_robot_at_rest_is_certain() -> None:
    found = at(history(*((1000 + 8 * i, 0.7) for i in range(10))), 1076, clock_ms=5.0)
    assert found.positions == pytest.approx([0.7])
    assert found.uncertainty.tolist() == [0.0]


def test_after_the_newest_it_extrapolates_with_an_uncertainty() -> None:
    known = history(*((1000 + 8 * i, 0.008 * i) for i in range(10)))
    found = at(known, 1172)
    assert found.positions == pytest.approx([0.172])
    # The speed is that of the last 32 ms, so half of that old.
    assert found.uncertainty == pytest.approx([ACCELERATION_MAX * 0.1 * (0.1 / 2 + 0.016) + 0.002], rel=0.01)


def test_the_robots_own_velocity_is_believed() -> None:
    assert at(history((1000, 0.0), (1008, 0.0), velocity=0.5), 1108).positions == pytest.approx([0.05])


def test_samples_that_come_in_bursts_do_not_make_the_robot_faster() -> None:
    """At 1 rad/s and 8 ms a sample, delayed by up to 20 ms: times are those of arrival."""
    arrivals_ms = (1000, 1008, 1016, 1024, 1032, 1058, 1058.2, 1058.4, 1064, 1072, 1100, 1100.1)
    known = history(*((at_ms, 0.008 * i) for i, at_ms in enumerate(arrivals_ms)))
    found = at(known, 1130)
    assert found.positions[0] == pytest.approx(0.088 + 0.030, abs=0.015)
    assert found.uncertainty[0] < 0.02


def test_between_samples_with_velocities_it_follows_their_curve() -> None:
    """At 30 Hz a robot that turns back deviates from the chord."""
    omega = 8.0
    known = JointHistory()
    for step in range(20):
        t_s = step / 30.0
        known.add([JointSample(S + round(t_s * S), (np.sin(omega * t_s) / 6.4,), (omega * np.cos(omega * t_s) / 6.4,))])
    for t_s in np.arange(0.0, 0.6, 0.007):
        found = known.at(S + round(t_s * S), 0, STALE_S)
        assert found is not None
        truth = np.sin(omega * t_s) / 6.4
        assert abs(found.positions[0] - truth) < 1e-4
        assert found.uncertainty[0] < 0.005


def test_the_truth_lies_within_the_uncertainty_of_any_motion_within_the_bound() -> None:
    omega = 4.0
    amplitude = ACCELERATION_MAX / omega**2
    known = JointHistory()
    for step in range(400):
        t_s = step * 0.008
        known.add([JointSample(S + round(t_s * S), (amplitude * np.sin(omega * t_s),), None)])
        for ahead_s in (0.0, 0.02, 0.07, 0.15):
            found = known.at(S + round((t_s + ahead_s) * S), 0, STALE_S)
            if step < 1 and found is None:
                continue
            assert found is not None
            truth = amplitude * np.sin(omega * (t_s + ahead_s))
            assert abs(found.positions[0] - truth) <= found.uncertainty[0] + 1e-3


def test_too_far_ahead_is_not_known() -> None:
    known = history((1000, 0.0), (1008, 0.0), velocity=0.0)
    limit_ms = 1008 + EXTRAPOLATION_MAX_S * 1e3
    assert known.at(round((limit_ms - 1) * MS), 0, STALE_S) is not None
    assert known.at(round((limit_ms + 1) * MS), 0, STALE_S) is None
    assert known.at(round(1060 * MS), 0, 0.05) is None


def test_before_the_oldest_or_without_any_nothing_is_known() -> None:
    assert history((1000, 0.0)).at(999 * MS, 0, STALE_S) is None
    assert JointHistory().at(999 * MS, 0, STALE_S) is None


def test_one_sample_alone_may_be_moving() -> None:
    known = history((1000, 0.3))
    found = at(known, 1030)
    assert found.positions == pytest.approx([0.3])
    assert found.uncertainty[0] > 0.06
    assert known.at(1060 * MS, 0, STALE_S) is None


def test_samples_too_far_apart_are_not_interpolated() -> None:
    """Otherwise a robot at rest would hide a person beside it."""
    assert at(history((1000, 0.0), (1190, 0.0)), 1100).uncertainty[0] <= UNCERTAINTY_MAX
    apart = history((1000, 0.0), (1210, 0.0))
    assert apart.at(1100 * MS, 0, STALE_S) is None


def test_a_joint_too_fast_for_its_time_is_not_known() -> None:
    fast = history((1000, 0.0), (1010, 0.3))
    assert fast.at(1005 * MS, 0, STALE_S) is not None
    assert fast.at(1005 * MS, 5 * MS, STALE_S) is None


def test_known_samples_are_skipped() -> None:
    known = history((1000, 0.0), (1010, 0.1))
    known.add([JointSample(1005 * MS, (9.0,), None), JointSample(1010 * MS, (9.0,), None)])
    assert at(known, 1010).positions == pytest.approx([0.1])


def test_another_robot_begins_anew() -> None:
    known = history((1000, 0.0), (1010, 1.0))
    known.add([JointSample(1020 * MS, (1.0, 2.0), None)])
    assert at(known, 1020).positions.tolist() == [1.0, 2.0]
    assert known.at(1015 * MS, 0, STALE_S) is None


def test_memory_is_bounded() -> None:
    known = history(*((1000 + 8 * i, 0.0) for i in range(HISTORY_SAMPLES + 50)))
    assert known.at(1000 * MS, 0, STALE_S) is None
    known.clear()
    assert known.newest_ns == 0
