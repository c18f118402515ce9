# SPDX-License-Identifier: Apache-2.0
"""Refinement of the camera's pose while a unit runs: gathers frames, refines, reports the pose to the master."""

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
from shared.messages import Command, Outcome, PoseQuality, Progress

logger = logging.getLogger(__name__)

REFINE_FRAMES = 30
"""A pose is refined by the median of so many frames: two seconds at 15 fps, in which people pass by."""


@dataclass(frozen=True, eq=False)
class RefinementFrames:
    """Frames of one refinement."""

    command: Command
    frames: list[NDArray[np.uint16]]
    refiner: Refiner


class RefinementTask:
    """Refinements of one unit's pose, one at a time."""

    def __init__(self, uplink: Uplink, assigned: AssignedPipeline, monitor: PoseMonitor) -> None:
        self._uplink = uplink
        self._assigned = assigned
        self._monitor = monitor
        self._gathered: RefinementFrames | None = None

    @property
    def progress(self) -> Progress | None:
        """Frames gathered of those needed; None while no refinement runs."""
        gathered = self._gathered
        return None if gathered is None else Progress(task="refinement", done=len(gathered.frames), total=REFINE_FRAMES)

    def begin(self, pipeline: DepthPipeline, command: Command) -> None:
        """Start to gather frames on `command`."""
        if self._gathered is not None:
            self._uplink.finish(self._gathered.command, Outcome("superseded", "a newer command started it anew"))
        self._gathered = RefinementFrames(command, [], pipeline.refiner())

    def gather(self, pipeline: DepthPipeline, depth: NDArray[np.uint16], joints: JointEstimate | None) -> None:
        """Keep a frame (H, W) without the robot's pixels, if a refinement needs frames."""
        gathered = self._gathered
        if gathered is None or len(gathered.frames) == REFINE_FRAMES:
            return
        if joints is None and pipeline.cell.robot is not None:
            # Without joints its position is not known, and it must not be taken for CAD.
            return
        gathered.frames.append(pipeline.without_robot(depth, None if joints is None else joints.positions))

    def take(self) -> RefinementFrames | None:
        """Return the frames once there are enough, and stop gathering; else None."""
        gathered = self._gathered
        if gathered is None or len(gathered.frames) < REFINE_FRAMES:
            return None
        self._gathered = None
        return gathered

    async def refine(self, gathered: RefinementFrames) -> None:
        """Refine the pose by the gathered frames in the background, and report it to the master."""
        try:
            found = await asyncio.to_thread(gathered.refiner.refine, gathered.frames)
            pipeline = self._assigned.pipeline
            if pipeline is None or not np.array_equal(pipeline.T_world_camera, gathered.refiner.T_world_camera):
                self._uplink.finish(gathered.command, Outcome("superseded", POSE_CHANGED))
                return
            if found.accepted:
                # If the camera was moved, its background model shows another place.
                self._assigned.refined = None if self._monitor.verdict.moved else found.T_world_camera
                await self._uplink.report_pose(found.T_world_camera, "refined", PoseQuality())
        except CellwatchError as error:
            self._uplink.finish(gathered.command, Outcome("failed", str(error)))
        else:
            outcome = Outcome("done" if found.accepted else "failed", found.reason)
            logger.info("refining the pose: %s, %s", outcome.code, outcome.detail)
            self._uplink.finish(gathered.command, outcome)
