# SPDX-License-Identifier: Apache-2.0
"""The joints at a frame's capture time, by the master's clock, and a check of the joints' delay."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge_unit.joints import DelayMonitor, JointEstimate
from edge_unit.pipeline import DepthPipeline
from edge_unit.pipeline.moving_model import EXACT
from edge_unit.sources.frame import DepthFrame
from edge_unit.uplink.assignment import Assignment
from edge_unit.uplink.uplink import Uplink
from shared.clock import NS_PER_S


class FrameJoints:
    """The joints of one unit's frames."""

    def __init__(self, uplink: Uplink) -> None:
        self._uplink = uplink
        self._delay = DelayMonitor()

    async def at(self, assignment: Assignment, frame: DepthFrame) -> JointEstimate | None:
        """Return the joints at the frame's capture time; None if they are not known."""
        robot = assignment.cell.robot
        if robot is None:
            return None
        if frame.joints is not None:
            return JointEstimate(frame.joints, np.zeros(robot.joint_count))
        clock = self._uplink.clock
        if not clock.known:
            return None
        at_ns = frame.captured_at_ns + clock.offset_ns + round(assignment.settings.joint_delay_s * NS_PER_S)
        await self._uplink.refresh_joints(at_ns)
        uncertainty_ns = clock.uncertainty_ns(frame.captured_at_ns)
        return self._uplink.joints.at(at_ns, uncertainty_ns, assignment.settings.robot_stale_after_s)

    def watch_delay(self, pipeline: DepthPipeline, frame: DepthFrame) -> Callable[[], None] | None:
        """Return a check of the joints' delay, to run in a thread in the background; mostly None: no check is due.

        Copies the frame if a later check needs it. Do not call it while another thread works with the pipeline.
        """
        clock = self._uplink.clock
        if frame.joints is not None or not clock.known:
            return None
        at_ns = frame.captured_at_ns + clock.offset_ns
        comparison = self._delay.next_comparison(self._uplink.joints)
        if self._delay.due(at_ns):
            self._delay.keep(pipeline, frame.depth, at_ns)
        return comparison

    def warning(self, joint_delay_s: float) -> str | None:
        """Return the value to set instead of `joint_delay_s` if that is clearly wrong, else None."""
        return self._delay.warning(joint_delay_s)


def known(joints: JointEstimate | None) -> tuple[NDArray[np.float64] | None, ArrayLike]:
    """Return positions (n,) and their uncertainty for the pipeline; None if they are not known."""
    return (None, EXACT) if joints is None else (joints.positions, joints.uncertainty)
