# SPDX-License-Identifier: Apache-2.0
"""A short history of the robot's joints. Each unit finds the joints at the time of its own frame in it."""

from __future__ import annotations

from collections import deque
from itertools import takewhile

from shared.clock import NS_PER_MS, NS_PER_S
from shared.errors import Refusal
from shared.messages import MAX_JOINT_SAMPLES, JointSample, JointsRequest, Reason, RobotState

HISTORY_SAMPLES = 2048
"""Four seconds of a robot that reports at 500 Hz; older frames of a unit are of no use."""

FUTURE_TOLERANCE_NS = 20 * NS_PER_MS
"""Tolerated error of the master's clock as a driver on another machine estimates it."""

ANSWER_SPACING_NS = 8 * NS_PER_MS
"""At 40 rad/s2, linear interpolation over 8 ms is wrong by 0.3 mrad: denser samples do not help a unit."""


class RobotJoints:
    """Joint samples by the master's clock, oldest first; bounded."""

    def __init__(self, joint_names: tuple[str, ...] | None) -> None:
        """`joint_names` of the cell's robot; None when the cell has no robot."""
        self.joint_names = joint_names
        self._history: deque[JointSample] = deque(maxlen=HISTORY_SAMPLES)

    def put(self, request: JointsRequest, now_ns: int) -> JointSample:
        """Store a joint sample.

        Raises:
            Refusal: 404 without a robot in the cell, 422 for a wrong count or a future time, 409 for an old time.
        """
        if self.joint_names is None:
            raise Refusal(404, "robot: the cell has no robot")
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
        """Return the latest sample; None without one."""
        return self._history[-1] if self._history else None

    def since(self, until_ns: int) -> tuple[JointSample, ...]:
        """Return the samples after `until_ns`: oldest first, thinned, always including the newest."""
        picked: list[JointSample] = []
        for sample in takewhile(lambda sample: sample.at_ns > until_ns, reversed(self._history)):
            if not picked or picked[-1].at_ns - sample.at_ns >= ANSWER_SPACING_NS:
                picked.append(sample)
                if len(picked) == MAX_JOINT_SAMPLES:
                    break
        return tuple(reversed(picked))

    def age_s(self, now_ns: int) -> float | None:
        """Return the seconds since the newest sample's time; None without one."""
        newest = self.newest
        return None if newest is None else (now_ns - newest.at_ns) / NS_PER_S

    def expires_at_ns(self, stale_after_s: float) -> int | None:
        """Return the time at which the newest sample is stale; None without one."""
        newest = self.newest
        return None if newest is None else newest.at_ns + round(stale_after_s * NS_PER_S)

    def state(self, now_ns: int, stale_after_s: float) -> tuple[RobotState, Reason | None]:
        """Return the robot's state, and the reason if units cannot filter the robot."""
        if self.joint_names is None:
            return "none", None
        age_s = self.age_s(now_ns)
        if age_s is None:
            return "silent", Reason("robot_silent", "the robot has not reported its joints yet")
        if age_s > stale_after_s:
            text = f"the robot's joints are {age_s:.1f} s old, at most {stale_after_s:g} s are trusted"
            return "stale", Reason("robot_stale", text, {"age_s": round(age_s, 1), "limit_s": stale_after_s})
        return "fresh", None
