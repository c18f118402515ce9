# SPDX-License-Identifier: Apache-2.0
"""The camera's pose refined while a unit runs: frames are gathered, and the pose that they tell goes to the master."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_unit.daemon.background_learning import POSE_CHANGED
from edge_unit.daemon.pipeline_manager import AssignedPipeline
from edge_unit.joints import JointEstimate
from edge_unit.monitoring import PoseMonitor
from edge_unit.pipeline import DepthPipeline, Refiner
from edge_unit.uplink.uplink import Uplink
from shared.errors import CellwatchError
from shared.messages import Command, Outcome, PoseQuality

logger = logging.getLogger(__name__)

REFINE_FRAMES = 30
"""Frames whose median a pose is refined by: two seconds at 15 fps, in which people pass by."""


@dataclass(frozen=True, eq=False)
class RefinementFrames:
    """Frames for the pose to be refined by."""

    command: Command
    frames: list[NDArray[np.uint16]]
    refiner: Refiner


class RefinementTask:
    """One unit's refinements, one at a time."""

    def __init__(self, uplink: Uplink, assigned: AssignedPipeline, stance: PoseMonitor) -> None:
        self._uplink = uplink
        self._assigned = assigned
        self._stance = stance
        self._gathered: RefinementFrames | None = None

    def begin(self, pipeline: DepthPipeline, command: Command) -> None:
        """Gather frames from now on, as `command` asks."""
        if self._gathered is not None:
            self._uplink.finish(self._gathered.command, Outcome("superseded", "it was asked to begin anew"))
        self._gathered = RefinementFrames(command, [], pipeline.refiner())

    def gather(self, pipeline: DepthPipeline, depth: NDArray[np.uint16], joints: JointEstimate | None) -> None:
        """Keep a frame (H, W) without the robot, when the pose is to be refined."""
        gathered = self._gathered
        if gathered is None or len(gathered.frames) == REFINE_FRAMES:
            return
        if joints is None and pipeline.cell.robot is not None:
            # Wherever it may stand: it must not be taken for CAD.
            return
        gathered.frames.append(pipeline.without_robot(depth, None if joints is None else joints.positions))

    def take(self) -> RefinementFrames | None:
        """The frames, once there are enough: then they are no longer kept."""
        gathered = self._gathered
        if gathered is None or len(gathered.frames) < REFINE_FRAMES:
            return None
        self._gathered = None
        return gathered

    async def refine(self, gathered: RefinementFrames) -> None:
        """Refine the pose by the frames gathered, while others are processed, and tell the master."""
        try:
            found = await asyncio.to_thread(gathered.refiner.refine, gathered.frames)
            pipeline = self._assigned.pipeline
            if pipeline is None or not np.array_equal(pipeline.T_world_camera, gathered.refiner.T_world_camera):
                self._uplink.finish(gathered.command, Outcome("superseded", POSE_CHANGED))
                return
            if found.accepted:
                # Of a camera that moved, what was learned shows another place.
                self._assigned.refined = None if self._stance.verdict.moved else found.T_world_camera
                await self._uplink.tell_pose(found.T_world_camera, "refined", PoseQuality())
        except CellwatchError as error:
            self._uplink.finish(gathered.command, Outcome("failed", str(error)))
        else:
            outcome = Outcome("done" if found.accepted else "failed", found.reason)
            logger.info("refining the pose: %s, %s", outcome.code, outcome.detail)
            self._uplink.finish(gathered.command, outcome)
