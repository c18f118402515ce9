# SPDX-License-Identifier: Apache-2.0
"""The robot's joints as a short history, so that every unit finds those of its own frame's time."""

from __future__ import annotations

from collections import deque
from itertools import takewhile

from shared.clock import NS_PER_MS, NS_PER_S
from shared.errors import Refusal
from shared.messages import MAX_JOINT_SAMPLES, JointSample, JointsRequest, Reason, RobotState

HISTORY_SAMPLES = 2048
"""Four seconds of a robot that reports at 500 Hz; no unit's frame is older when it is still of use."""

FUTURE_TOLERANCE_NS = 20 * NS_PER_MS
"""A driver on another machine has estimated the master's clock; this is how wrong it may be."""

ANSWER_SPACING_NS = 8 * NS_PER_MS
"""At 40 rad/s2, linear interpolation over 8 ms is wrong by 0.3 mrad: denser samples tell a unit nothing more."""


class RobotJoints:
    """Joint samples by the master's clock, oldest first; bounded."""

    def __init__(self, joint_names: tuple[str, ...] | None) -> None:
        """`joint_names` of the cell's robot; None when the cell has no robot."""
        self.joint_names = joint_names
        self._history: deque[JointSample] = deque(maxlen=HISTORY_SAMPLES)

    def put(self, request: JointsRequest, now_ns: int) -> JointSample:
        """Take in where the robot is.

        Raises:
            Refusal: 404 without a robot in the cell, 422 for a wrong count or a time to come, 409 for one gone by.
        """
        if self.joint_names is None:
            raise Refusal(404, "robot: this cell has none")
        count = len(self.joint_names)
        for name, values in (("positions", request.positions), ("velocities", request.velocities)):
            if values is not None and len(values) != count:
                names = ", ".join(self.joint_names)
                raise Refusal(422, f"{name}: expected {count} numbers ({names}), got {len(values)}")
        at_ns = now_ns if request.at_ns is None else request.at_ns
        if at_ns > now_ns + FUTURE_TOLERANCE_NS:
            raise Refusal(422, f"at_ns: expected the master's clock, now {now_ns}, got {at_ns - now_ns} ns later")
        newest = self.newest
        if newest is not None and at_ns <= newest.at_ns:
            raise Refusal(409, f"at_ns: expected a time after {newest.at_ns}, which is known already, got {at_ns}")
        sample = JointSample(at_ns, request.positions, request.velocities)
        self._history.append(sample)
        return sample

    @property
    def newest(self) -> JointSample | None:
        """The latest sample, if there is any."""
        return self._history[-1] if self._history else None

    def since(self, until_ns: int) -> tuple[JointSample, ...]:
        """What a unit lacks that has all up to `until_ns`: oldest first, thinned, always with the newest."""
        picked: list[JointSample] = []
        for sample in takewhile(lambda sample: sample.at_ns > until_ns, reversed(self._history)):
            if not picked or picked[-1].at_ns - sample.at_ns >= ANSWER_SPACING_NS:
                picked.append(sample)
                if len(picked) == MAX_JOINT_SAMPLES:
                    break
        return tuple(reversed(picked))

    def age_s(self, now_ns: int) -> float | None:
        """Seconds since the newest sample's time."""
        newest = self.newest
        return None if newest is None else (now_ns - newest.at_ns) / NS_PER_S

    def expires_at_ns(self, stale_after_s: float) -> int | None:
        """When the newest sample becomes too old; None without one."""
        newest = self.newest
        return None if newest is None else newest.at_ns + round(stale_after_s * NS_PER_S)

    def state(self, now_ns: int, stale_after_s: float) -> tuple[RobotState, Reason | None]:
        """Whether units can filter the robot, and why not."""
        if self.joint_names is None:
            return "none", None
        age_s = self.age_s(now_ns)
        if age_s is None:
            return "silent", Reason("robot_silent", "the robot has not reported its joints yet")
        if age_s > stale_after_s:
            text = f"the robot's joints are {age_s:.1f} s old, at most {stale_after_s:g} s are trusted"
            return "stale", Reason("robot_stale", text, {"age_s": round(age_s, 1), "limit_s": stale_after_s})
        return "fresh", None
