# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import itertools

import pytest

from master_server.core import RobotJoints
from master_server.core.robot_joints import ANSWER_SPACING_NS, FUTURE_TOLERANCE_NS, HISTORY_SAMPLES
from shared.errors import Refusal
from shared.messages import MAX_JOINT_SAMPLES, JointsRequest

NAMES = ("shoulder", "elbow")
MS = 1_000_000
S = 1_000_000_000


def put(robot: RobotJoints, at_ns: int, value: float = 0.0) -> None:
    robot.put(JointsRequest(positions=(value, value), at_ns=at_ns), at_ns)


def test_joints_without_a_time_get_the_time_of_arrival() -> None:
    robot = RobotJoints(NAMES)
    assert robot.put(JointsRequest(positions=(1.0, 2.0)), 77).at_ns == 77


def test_states() -> None:
    robot = RobotJoints(NAMES)
    state, cause = robot.state(S, 0.5)
    assert cause is not None
    assert (state, cause.code, cause.numbers) == ("silent", "robot_silent", {})
    put(robot, S)
    assert robot.state(S + 500 * MS, 0.5) == ("fresh", None)
    state, cause = robot.state(S + 501 * MS, 0.5)
    assert cause is not None
    assert (state, cause.code, cause.numbers) == ("stale", "robot_stale", {"age_s": 0.5, "limit_s": 0.5})
    assert "0.5 s" in cause.sentence
    assert RobotJoints(None).state(S, 0.5) == ("none", None)


@pytest.mark.parametrize(
    ("request_", "status", "words"),
    [
        (JointsRequest(positions=(1.0,)), 422, r"positions: expected 2 numbers \(shoulder, elbow\), got 1"),
        (JointsRequest(positions=(1.0, 2.0), velocities=(1.0,)), 422, "velocities: expected 2"),
        (JointsRequest(positions=(1.0, 2.0), at_ns=S + FUTURE_TOLERANCE_NS + 1), 422, "master's clock"),
        (JointsRequest(positions=(1.0, 2.0), at_ns=S // 2), 409, "after"),
    ],
)
def test_refusals(request_: JointsRequest, status: int, words: str) -> None:
    robot = RobotJoints(NAMES)
    put(robot, S // 2)
    with pytest.raises(Refusal, match=words) as caught:
        robot.put(request_, S)
    assert caught.value.status == status
    assert robot.newest is not None
    assert robot.newest.at_ns == S // 2


def test_a_cell_without_a_robot_takes_no_joints() -> None:
    with pytest.raises(Refusal, match="no robot"):
        RobotJoints(None).put(JointsRequest(positions=()), S)


def test_new_samples_are_thinned_and_include_the_newest() -> None:
    robot = RobotJoints(NAMES)
    for step in range(101):
        put(robot, S + step * 2 * MS, float(step))
    samples = robot.since(S + 100 * MS)
    times = [sample.at_ns for sample in samples]
    assert times == sorted(times)
    assert times[0] > S + 100 * MS
    assert times[-1] == S + 200 * MS
    gaps = [b - a for a, b in itertools.pairwise(times)]
    assert min(gaps) >= ANSWER_SPACING_NS
    assert max(gaps) <= ANSWER_SPACING_NS + 2 * MS
    assert robot.since(S + 200 * MS) == ()


def test_history_and_answers_are_bounded() -> None:
    robot = RobotJoints(NAMES)
    for step in range(HISTORY_SAMPLES + 100):
        put(robot, S + step * 8 * MS)
    assert len(robot.since(0)) == MAX_JOINT_SAMPLES
    assert robot.since(0)[-1] == robot.newest
