# SPDX-License-Identifier: Apache-2.0
"""Simulated delivery of a robot's joint samples to the master: late, jittering, some lost, with or without times."""

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
"""Time of the master's clock at time 0 of the path."""

SPACING_S = 1e-4
"""Minimum time between two messages of one connection. A late message holds up those behind it."""

CLOCK_UNCERTAINTY_NS = NS_PER_S // 1000
"""Uncertainty of the clock offset: half a round trip in a busy network."""


@dataclass(frozen=True)
class Delivery:
    """Delivery of samples: late by `delay_s` plus a mean of `jitter_s` (exponential); `lost_share` of them are lost.

    Without `stamped` samples carry no time, and the time of arrival counts. The unit corrects by `configured_delay_s`.
    """

    name: str
    rate_hz: float = 125.0
    delay_s: float = 0.04
    jitter_s: float = 0.0
    lost_share: float = 0.0
    stamped: bool = True
    velocities: bool = True
    configured_delay_s: float = 0.0


class Delivered:
    """A master and a unit that receive a path through a delivery. Query them in the order of time."""

    def __init__(self, delivery: Delivery, path: JointPath, seconds: float, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        # Samples start before the path does, so that the robot already moves in the first frame.
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

    def joints_at(self, captured_s: float, queried_s: float, stale_after_s: float) -> JointEstimate | None:
        """Return the unit's estimate, at `queried_s`, of the joints at `captured_s`."""
        delivery = self._delivery
        while self._coming and self._coming[0][0] <= queried_s:
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
        return self._unit.at(_ns(captured_s + delivery.configured_delay_s), CLOCK_UNCERTAINTY_NS, stale_after_s)


def _ns(t_s: float) -> int:
    return EPOCH_NS + round(t_s * NS_PER_S)
