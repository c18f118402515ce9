# SPDX-License-Identifier: Apache-2.0
"""A robot's joint samples as they reach the master: late, jittering, some lost, with or without their times."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from edge_unit.joints import JointEstimate, JointHistory
from master_server.core import RobotJoints
from shared.clock import NS_PER_S
from shared.messages import JointsRequest
from simulation.world.robot_path import JointPath

EPOCH_NS = NS_PER_S
"""The master's clock at the path's time 0."""

SPACING_S = 1e-4
"""Messages of one connection come one after the other, a late one holding up those behind it."""

CLOCK_UNCERTAINTY_NS = NS_PER_S // 1000
"""Half a round trip in a busy network."""


@dataclass(frozen=True)
class Delivery:
    """How samples come: `delay_s` and, on average, `jitter_s` (exponential) late; `lost_share` of them never.

    Without `stamped` they carry no time and count from their arrival. The unit is told `told_delay_s`.
    """

    name: str
    rate_hz: float = 125.0
    delay_s: float = 0.04
    jitter_s: float = 0.0
    lost_share: float = 0.0
    stamped: bool = True
    velocities: bool = True
    told_delay_s: float = 0.0


class Delivered:
    """A master and a unit that are told of a path by a delivery; to be asked in the order of time."""

    def __init__(self, delivery: Delivery, path: JointPath, seconds: float, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        # From before the path's begin, so that the first frame finds the robot under way.
        at_s = np.arange(-0.5, seconds + 0.5, 1.0 / delivery.rate_hz)
        late_s = delivery.delay_s + rng.exponential(delivery.jitter_s, len(at_s)) * (delivery.jitter_s > 0.0)
        kept = rng.random(len(at_s)) >= delivery.lost_share
        at_s, late_s = at_s[kept], late_s[kept]
        order = SPACING_S * np.arange(len(at_s))
        arrives_s = np.maximum.accumulate(at_s + late_s - order) + order
        self._delivery = delivery
        self._path = path
        self._coming = deque(zip(arrives_s.tolist(), at_s.tolist(), strict=True))
        joints = path.joints_at(0.0)
        self._master = RobotJoints(tuple(f"joint_{i}" for i in range(len(joints))))
        self._unit = JointHistory()

    def joints_at(self, captured_s: float, asked_s: float, stale_after_s: float) -> JointEstimate | None:
        """What the unit knows at `asked_s` of where the robot was at `captured_s`."""
        delivery = self._delivery
        while self._coming and self._coming[0][0] <= asked_s:
            arrives_s, at_s = self._coming.popleft()
            self._master.put(
                JointsRequest(
                    positions=tuple(self._path.joints_at(at_s).tolist()),
                    velocities=tuple(self._path.velocities_at(at_s).tolist()) if delivery.velocities else None,
                    at_ns=_ns(at_s) if delivery.stamped else None,
                ),
                _ns(arrives_s),
            )
        self._unit.add(self._master.since(self._unit.newest_ns))
        return self._unit.at(_ns(captured_s + delivery.told_delay_s), CLOCK_UNCERTAINTY_NS, stale_after_s)


def _ns(t_s: float) -> int:
    return EPOCH_NS + round(t_s * NS_PER_S)
