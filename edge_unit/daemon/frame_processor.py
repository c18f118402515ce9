# SPDX-License-Identifier: Apache-2.0
"""All slow work on a frame, in a thread, so that the event loop stays free for the master."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Iterable, Iterator
from typing import Any

from edge_unit.daemon.background_learning import BackgroundLearning
from edge_unit.daemon.joint_lookup import FrameJoints, known
from edge_unit.daemon.pipeline_manager import AssignedPipeline
from edge_unit.daemon.refinement_task import RefinementTask
from edge_unit.daemon.report import health_of, parts_of, troubled, within_bounds
from edge_unit.joints import JointEstimate
from edge_unit.monitoring import PoseMonitor, StageTimer
from edge_unit.pipeline import DepthPipeline
from edge_unit.sources.frame import DepthFrame
from edge_unit.uplink.assignment import Assignment, Report, Trouble
from shared.errors import InputError
from shared.messages import Command, Outcome
from shared.transforms import Transform
from shared.wire import keys_to_bytes

logger = logging.getLogger(__name__)


class FrameProcessor:
    """Makes a report from a frame. Not for use from several threads at once.

    Attributes:
        assigned: the pipeline as the master's latest assignment has it.
        learning: the background model, and the run that learns it.
        joints: the robot's joints at a frame's time.
    """

    def __init__(
        self,
        finish: Callable[[Command, Outcome], None],
        assigned: AssignedPipeline,
        learning: BackgroundLearning,
        refining: RefinementTask,
        monitor: PoseMonitor,
        joints: FrameJoints,
    ) -> None:
        """`finish` receives the outcome of each command."""
        self._finish = finish
        self.assigned = assigned
        self.learning = learning
        self._refining = refining
        self._monitor = monitor
        self.joints = joints

    def process(
        self,
        assignment: Assignment,
        T_world_camera: Transform,
        frame: DepthFrame,
        joints: JointEstimate | None,
        changes: Iterable[Command],
        stages: StageTimer,
    ) -> Report:
        """Carry out `changes` and make the report of `frame`; a failure is the report's trouble."""
        try:
            pipeline = self._prepare(assignment, T_world_camera, changes)
            pending = self.learning.add(pipeline, self.assigned.place, frame.depth, joints)
            if pending is not None:
                return troubled(assignment, frame, pending)
            return self._report(pipeline, assignment, frame, joints, stages)
        except InputError as error:
            logger.warning("frame %d: %s", frame.frame_number, error)
            return troubled(assignment, frame, Trouble("frame", str(error)))

    def _prepare(self, assignment: Assignment, T_world_camera: Transform, changes: Iterable[Command]) -> DepthPipeline:
        """Return the pipeline for the assignment after `changes`; without a pipeline no command can be carried out."""
        try:
            pipeline = self.assigned.prepare(assignment, T_world_camera)
        except InputError as error:
            for command in changes:
                self._finish(command, Outcome("refused", str(error)))
            raise
        for command in changes:
            self._execute(command, pipeline)
        return pipeline

    def _execute(self, command: Command, pipeline: DepthPipeline) -> None:
        """Carry out a command; one that needs several frames only starts here."""
        if command.verb == "learn_background":
            self.learning.begin(pipeline, command)
        elif command.verb == "drop_background":
            self.learning.drop(pipeline, command)
        elif command.verb == "refine":
            self._refining.begin(pipeline, command)
        else:
            self._finish(command, Outcome("refused", f"this unit does not know the command {command.verb}"))

    def _report(
        self,
        pipeline: DepthPipeline,
        assignment: Assignment,
        frame: DepthFrame,
        joints: JointEstimate | None,
        stages: StageTimer,
    ) -> Report:
        """Filter a frame, and judge the health of its camera."""
        stages.end("thread")
        positions, uncertainty = known(joints)
        is_due = self._monitor.due(frame.captured_at_ns)
        result = pipeline.process(frame.depth, positions, joint_uncertainty_rad=uncertainty, with_misfit=is_due)
        stages.end("check", parts_of(result.times))
        voxels, seen, crowd = within_bounds(result, pipeline.T_world_camera)
        verdict = self._monitor.watch(result.misfit, pipeline.static_version, frame.captured_at_ns)
        warning = verdict.warning or self.joints.warning(assignment.settings.joint_delay_s) or crowd
        health = health_of(result, frame, verdict, warning)
        self._refining.gather(pipeline, frame.depth, joints)
        if (progress := self._refining.progress) is not None:
            health = health.model_copy(update={"progress": progress})
        keys = keys_to_bytes(voxels.keys)
        stages.end("report")
        return Report(assignment, frame.captured_at_ns, keys, seen, health, stages.took_ns)

    def afterwards(
        self, frame: DepthFrame, joints: JointEstimate | None, report: Report
    ) -> Iterator[Coroutine[Any, Any, None]]:
        """Yield the work that follows a processed frame, to run on the event loop beside the next frames."""
        pipeline = self.assigned.pipeline
        if pipeline is not None and joints is not None and report.health.trouble is None:
            comparison = self.joints.watch_delay(pipeline, frame)
            if comparison is not None:
                yield asyncio.to_thread(comparison)
        if self._monitor.unsaved:
            yield asyncio.to_thread(self._monitor.save)
        gathered = self._refining.take()
        if gathered is not None:
            yield self._refining.refine(gathered)
