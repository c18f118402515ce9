# SPDX-License-Identifier: Apache-2.0
"""The daemon: source, pipeline and uplink held together.

Frames are processed one after the other in a thread, while the event loop talks to the master. What the master
changes (settings, cell, pose) is an `Assignment`, applied between two frames; a report carries the one that it was
made with, so that nothing is ever merged under another lattice, cell or pose than it was made for.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import importlib.metadata
import logging
from collections.abc import AsyncGenerator, Coroutine
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_unit.background import BackgroundStore, Place
from edge_unit.board_layout import require_board
from edge_unit.board_search import BoardSearch
from edge_unit.camera_memory import CameraMemory
from edge_unit.cell_cache import CellCache
from edge_unit.client import MasterClient
from edge_unit.config import SourceConfig, UnitConfig
from edge_unit.delay_watch import DelayWatch
from edge_unit.joints import JointEstimate
from edge_unit.master_search import MasterSearch
from edge_unit.pictures import picture_raw, png_of
from edge_unit.pipeline import EXACT, DepthPipeline
from edge_unit.progress import Progress
from edge_unit.reference import ReferenceLearner
from edge_unit.refine import Refiner
from edge_unit.rehearsal import rehearse
from edge_unit.sources.frame import CameraInfo, DepthFrame, DepthSource
from edge_unit.sources.realsense import RealsenseSource, RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from edge_unit.sources.simulated import SimulatedSource
from edge_unit.sources.status import ReportsStatus
from edge_unit.stages import Stages
from edge_unit.stance import Stance, Verdict, place_of
from edge_unit.trace import Trace, TraceRecord
from edge_unit.uplink import Assignment, Delivery, Report, Uplink
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, InputError, SourceError
from shared.messages import DONE, MAX_TEXT, MAX_VOXELS, Command, Health, ImageKind, PoseQuality, ToldOrigin
from shared.settings import FilterSettings
from shared.transforms import Transform
from shared.wire import keys_to_bytes

logger = logging.getLogger(__name__)

LEARN_FRAMES = 60
"""Frames of the empty cell when an operator asks and the configuration names no number: four seconds at 15 fps."""

REOPEN_MIN_S = 0.2
REOPEN_MAX_S = 5.0
"""Between attempts to open a camera that does not deliver."""

REHEARSAL_S = 5.0
"""For kernels to be read from disk, on a busy machine."""

FRAME_S_MAX = 5.0
"""For one frame, where nothing has to be prepared: a hundred times what the slowest board takes."""

PREPARE_S_MAX = 240.0
"""For kernels to be compiled and a cell to be drawn anew on a board that has just begun to do both."""

DRAIN_S = 2.0
"""For the last frame of a recording to reach the master."""

REFINE_FRAMES = 30
"""Frames whose median a pose is refined by: two seconds at 15 fps, in which people pass by."""

NO_POSE = "the pose of its camera is not known yet"

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass
class _Learning:
    """A background that is being learned."""

    learner: ReferenceLearner
    frames: int
    command: Command | None


@dataclass
class _Refining:
    """Frames that are gathered for the pose to be refined by."""

    command: Command
    frames: list[NDArray[np.uint16]]
    refiner: Refiner


class Unit:
    """One camera, one master; `run` until cancelled or until a recording ends."""

    def __init__(self, config: UnitConfig, source: DepthSource, client: MasterClient | None = None) -> None:
        """Reads and opens files, so make it before the event loop runs.

        Raises:
            ConfigError: the trace cannot be written, or the configured pose cannot be read.
        """
        self._config = config
        self._source = source
        self._masters: MasterSearch | None = None
        if client is None:
            self._masters = MasterSearch(config)
            client = MasterClient(config.master_url, config.read_token, config.source_address, tls=config.tls())
        self._client = client
        configured = config.T_world_camera
        self._pose: tuple[Transform, ToldOrigin] | None = (
            None if configured is None else (configured.transform(), "configured")
        )
        self._store = BackgroundStore(config.state_dir)
        self._memory = CameraMemory(config.state_dir)
        self._stance = Stance(config.state_dir)
        self._delay = DelayWatch()
        self._trace = None if config.trace_path is None else Trace(config.trace_path)
        self._camera: CameraInfo | None = None
        self._pipeline: DepthPipeline | None = None
        self._applied: Assignment | None = None
        self._learning: _Learning | None = None
        self._refining: _Refining | None = None
        self._refined: Transform | None = None
        self._rehearsal: asyncio.Task[None] | None = None
        self._search = BoardSearch(source, config.board_stream)
        self._next_at_ns = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._trouble: str | None = "no frame yet"
        self._progress = Progress()
        self._taken = 0
        self._told = 0, monotonic_ns()
        self.uplink = Uplink(
            self._client,
            CellCache(config.state_dir / "cell"),
            f"edge-unit {importlib.metadata.version('cellwatch')}",
            _boot_id(),
            self._note,
            self._masters,
        )

    async def run(self) -> None:
        """Watch and report.

        Raises:
            ConfigError: there is no token.
            SourceError: a recording is missing or malformed.
        """
        async with self._client:
            tasks = [asyncio.create_task(self.uplink.run()), asyncio.create_task(self._watch())]
            if self._masters is not None:
                tasks.append(asyncio.create_task(self._masters.run()))
            if isinstance(self._source, ReportsStatus):
                tasks.append(asyncio.create_task(self._follow_status(self._source)))
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in (*tasks, *self._tasks):
                    task.cancel()
                results = await asyncio.gather(*tasks, return_exceptions=True)
                await asyncio.gather(*self._tasks, return_exceptions=True)
                await asyncio.to_thread(self._close)
            for result in results:
                if isinstance(result, Exception):
                    raise result

    # ------------------------------------------------------------------ how it goes

    def status(self) -> str:
        """One line for a person: camera, frames a second since it was asked last, master."""
        taken, now_ns = self._taken, monotonic_ns()
        (before, since_ns), self._told = self._told, (taken, now_ns)
        trouble = self.uplink.trouble or self._trouble
        if trouble is None:
            trouble = f"live, {(taken - before) * NS_PER_S / max(now_ns - since_ns, 1):.1f} fps"
        return f"{trouble}; {self.uplink.standing}"

    def stuck(self) -> str | None:
        """What hangs and will not come to its end by itself; waiting for a camera or a master is not of that kind."""
        return self._progress.stuck(monotonic_ns())

    # ------------------------------------------------------------------ frames

    async def _watch(self) -> None:
        """Take frames for as long as there are any; a camera that fails is opened again."""
        retry_s = REOPEN_MIN_S
        while True:
            try:
                await self._open()
                frames = self._source.frames()
                try:
                    async for frame in frames:
                        retry_s = REOPEN_MIN_S
                        await self._take(frame)
                finally:
                    if isinstance(frames, AsyncGenerator):
                        await frames.aclose()
                await self.uplink.drained(DRAIN_S)
                learning = self._learning
                if learning is None:
                    logger.info("the recording has come to its end")
                else:
                    done, wanted = learning.learner.frames, learning.frames
                    logger.warning("the recording ended after %d of the %d frames to be learned", done, wanted)
                return
            except SourceError as error:
                if _is_recording(self._config.source):
                    raise
                logger.warning("%s", error)
                self.uplink.trouble = f"camera: {error}"[:MAX_TEXT]
                await self._register_without_camera()
            finally:
                await self._source.close()
            await asyncio.sleep(retry_s)
            retry_s = min(2.0 * retry_s, REOPEN_MAX_S)

    async def _open(self) -> None:
        if self._rehearsal is None:
            self._rehearsal = asyncio.create_task(asyncio.to_thread(self._rehearse))
        camera = await self._source.open()
        # Who registers is live with the next frame; but a unit that has to compile first tells that it is there.
        await asyncio.wait((self._rehearsal,), timeout=REHEARSAL_S)
        if self._camera is not None and camera.serial != self._camera.serial:
            logger.warning("the camera changed from %s to %s", self._camera.serial, camera.serial)
        self._camera, self._pipeline, self._applied = camera, None, None
        pose = camera.T_world_camera
        self.uplink.set_camera(camera, self._pose or (None if pose is None else (pose, "source")))
        self.uplink.trouble = None
        await asyncio.to_thread(self._memory.save, camera)
        await asyncio.gather(self.uplink.assigned.wait(), self._rehearsal)
        assignment = self.uplink.assignment
        if assignment is not None and assignment.T_world_camera is not None:
            # Before the camera delivers, so that no frame has to wait for what is compiled and drawn only once.
            # What cannot be prepared is told with each frame, for the master may change it.
            with contextlib.suppress(InputError), self._progress.working("preparing for frames", PREPARE_S_MAX):
                await asyncio.to_thread(self._prepared, assignment, assignment.T_world_camera)

    async def _register_without_camera(self) -> None:
        """Have the master know of a camera that should be here: the one that was, if it did not deliver yet."""
        if self._camera is None:
            remembered = await asyncio.to_thread(self._memory.load)
            wanted = getattr(self._config.source, "serial", None)
            if remembered is not None and wanted in (None, remembered.serial):
                self.uplink.set_camera(remembered, self._pose)

    async def _follow_status(self, source: ReportsStatus) -> None:
        """Tell at once how the camera is doing, for the next frame may be long in coming."""
        status = source.status
        while True:
            if status.state != "closed":
                trouble = status.trouble
                self.uplink.trouble = None if trouble is None else trouble[:MAX_TEXT]
                self.uplink.warning = status.warning[:MAX_TEXT] or None
                if status.state == "absent":
                    await self._register_without_camera()
            status = await source.next_status(status)

    async def _take(self, frame: DepthFrame) -> None:
        """Process one frame and offer the result."""
        if self._config.fps_max is not None:
            if frame.captured_at_ns < self._next_at_ns:
                return
            self._next_at_ns = frame.captured_at_ns + round(0.9 * NS_PER_S / self._config.fps_max)
        assignment = self.uplink.assignment or self._applied
        if assignment is None:
            return
        commands = self._take_commands()
        asked = [command for command in commands if command.verb == "calibrate"]
        if asked:
            for command in commands:
                if command not in asked:
                    self.uplink.commands.put_nowait(command)
            outcome = await self._localise(assignment, frame)
            for command in asked:
                self.uplink.finish(command, outcome)
            # The frame is of before the look, and its memory may be gone.
            return
        if assignment.T_world_camera is None:
            self._pipeline = None
            for command in commands:
                if command.verb != "image":
                    self.uplink.finish(command, NO_POSE)
            searching = f"looking for the board: {self._search.outcome}"[:MAX_TEXT] if self._search.outcome else None
            health = Health(frame=frame.frame_number, trouble=searching)
            self._trouble = searching or NO_POSE
            self.uplink.offer(Report(assignment, frame.captured_at_ns, health=health))
            await self._show(commands, frame, None)
            if self._localises(assignment) and self._search.due(monotonic_ns()):
                await self._localise(assignment, frame)
            return
        stages = Stages(frame.captured_at_ns)
        stages.end("source")
        joints = await self._joints_at(assignment, frame)
        stages.end("joints")
        pose = assignment.T_world_camera
        with self._progress.working(f"frame {frame.frame_number}", self._limit_s(assignment, commands)):
            report = await asyncio.to_thread(self._process, assignment, pose, frame, joints, commands, stages)
        self._taken += 1
        if (report.health.trouble is None) != (self._trouble is None):
            logger.info("%s", report.health.trouble or "frames are filtered and reported")
        self._trouble = report.health.trouble
        self.uplink.offer(report)
        await self._show(commands, frame, joints)
        if joints is not None and report.health.trouble is None:
            await self._watch_delay(frame)
        refining = self._refining
        if refining is not None and len(refining.frames) == REFINE_FRAMES:
            self._refining = None
            self._in_background(self._refine(refining))

    def _limit_s(self, assignment: Assignment, commands: list[Command]) -> float:
        """How long a frame may take: longer where the cell is drawn anew for it, or something was asked for."""
        return FRAME_S_MAX if assignment is self._applied and not commands else PREPARE_S_MAX

    async def _show(self, commands: list[Command], frame: DepthFrame, joints: JointEstimate | None) -> None:
        """Draw the pictures that were asked for; they are encoded and sent while the next frame is taken."""
        for command in commands:
            if command.verb == "image" and command.image is not None:
                try:
                    picture = await asyncio.to_thread(self._picture, command.image, frame, joints)
                except InputError as error:
                    self.uplink.finish(command, str(error))
                    continue
                self._in_background(self._send(command, picture))

    async def _send(self, command: Command, picture: NDArray[np.uint16]) -> None:
        assert self._camera is not None
        scale_m = self._camera.intrinsics.depth_scale_m
        try:
            png = await asyncio.to_thread(png_of, picture, scale_m, command.raw)
            await self.uplink.send_picture(command, png)
        except CellwatchError as error:
            self.uplink.finish(command, str(error))
        else:
            self.uplink.finish(command)

    async def _refine(self, refining: _Refining) -> None:
        """Refine the pose by the frames gathered, while others are processed, and tell the master."""
        try:
            found = await asyncio.to_thread(refining.refiner.refine, refining.frames)
            pipeline = self._pipeline
            if pipeline is None or not np.array_equal(pipeline.T_world_camera, refining.refiner.T_world_camera):
                raise InputError("the camera's pose changed meanwhile")
            if found.accepted:
                # Of a camera that moved, what was learned shows another place.
                self._refined = None if self._stance.verdict.moved else found.T_world_camera
                await self.uplink.tell_pose(found.T_world_camera, "refined", PoseQuality())
        except CellwatchError as error:
            self.uplink.finish(refining.command, str(error)[:MAX_TEXT])
        else:
            outcome = f"{DONE}: {found.reason}" if found.accepted else found.reason
            logger.info("refining the pose: %s", outcome)
            self.uplink.finish(refining.command, outcome[:MAX_TEXT])

    def _in_background(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _localises(self, assignment: Assignment) -> bool:
        """Whether to look for the board without being asked."""
        return self._config.localise and assignment.cell.board is not None

    async def _localise(self, assignment: Assignment, frame: DepthFrame) -> str:
        """Look for the board while depth pauses, and tell the master the pose; returns what came of it."""

        def tell(seen: str) -> None:
            self.uplink.offer(_troubled(assignment, frame, seen))

        search = self._search
        first = not search.outcome
        try:
            found = await search.look(require_board(assignment.cell.board), tell)
            quality = PoseQuality(
                uncertainty_mm=round(found.uncertainty_mm, 3),
                uncertainty_deg=round(found.uncertainty_deg, 4),
                reprojection_px=round(found.reprojection_px, 4),
            )
            await self.uplink.tell_pose(found.T_world_camera, "board", quality)
        except CellwatchError as error:
            # It looks for ever, but says so once.
            logger.log(logging.WARNING if first else logging.DEBUG, "%s", error)
            tell(f"looking for the board: {error}")
            return str(error)
        logger.info(
            "found the board in %d of %d pictures: the pose is known to %.1f mm and %.2f degrees",
            found.frames_used,
            found.frames_seen,
            found.uncertainty_mm,
            found.uncertainty_deg,
        )
        return DONE

    async def _joints_at(self, assignment: Assignment, frame: DepthFrame) -> JointEstimate | None:
        """Where the robot was when the frame was taken; None when nobody knows."""
        robot = assignment.cell.robot
        if robot is None:
            return None
        if frame.joints is not None:
            return JointEstimate(frame.joints, np.zeros(robot.joint_count))
        clock = self.uplink.clock
        if not clock.known:
            return None
        at_ns = frame.captured_at_ns + clock.offset_ns + round(assignment.settings.joint_delay_s * NS_PER_S)
        await self.uplink.refresh_joints(at_ns)
        uncertainty_ns = clock.uncertainty_ns(frame.captured_at_ns)
        return self.uplink.joints.at(at_ns, uncertainty_ns, assignment.settings.robot_stale_after_s)

    async def _watch_delay(self, frame: DepthFrame) -> None:
        """Look whether the joints are later than the settings say; the frame was offered and need not wait."""
        pipeline, clock = self._pipeline, self.uplink.clock
        if frame.joints is not None or pipeline is None or not clock.known:
            return
        at_ns = frame.captured_at_ns + clock.offset_ns
        joints = self._delay.joints(self.uplink.joints)
        if joints is not None:
            await asyncio.to_thread(self._delay.look, joints)
        if self._delay.due(at_ns):
            await asyncio.to_thread(self._delay.keep, pipeline, frame.depth, at_ns)

    def _take_commands(self) -> list[Command]:
        commands = []
        while not self.uplink.commands.empty():
            commands.append(self.uplink.commands.get_nowait())
        return commands

    # ------------------------------------------------------------------ in the thread

    def _rehearse(self) -> None:
        with self._progress.working("compiling the kernels", PREPARE_S_MAX):
            rehearse()

    def _picture(self, kind: ImageKind, frame: DepthFrame, joints: JointEstimate | None) -> NDArray[np.uint16]:
        """A picture of the frame that was processed last."""
        if kind == "depth":
            return frame.depth.copy()
        if self._pipeline is None:
            raise InputError(NO_POSE)
        positions, uncertainty = (None, EXACT) if joints is None else (joints.positions, joints.uncertainty)
        return picture_raw(kind, frame.depth, self._pipeline, positions, uncertainty)

    def _process(
        self,
        assignment: Assignment,
        T_world_camera: Transform,
        frame: DepthFrame,
        joints: JointEstimate | None,
        commands: list[Command],
        stages: Stages,
    ) -> Report:
        """Everything about a frame that takes time."""
        if self._trace is not None:
            self._trace.flush()
        try:
            try:
                pipeline = self._prepared(assignment, T_world_camera)
            except InputError as error:
                for command in commands:
                    if command.verb != "image":
                        self.uplink.finish(command, str(error))
                raise
            for command in commands:
                self._obey(command, pipeline)
            if self._learning is not None:
                return self._learn(self._learning, pipeline, assignment, frame, joints, stages)
            return self._report(pipeline, assignment, frame, joints, stages)
        except InputError as error:
            logger.warning("frame %d: %s", frame.frame_number, error)
            return _troubled(assignment, frame, str(error))

    def _prepared(self, assignment: Assignment, T_world_camera: Transform) -> DepthPipeline:
        """The pipeline as the assignment has it."""
        assert self._camera is not None
        pipeline, applied = self._pipeline, self._applied
        if pipeline is None or applied is None:
            pipeline = DepthPipeline(
                self._camera.intrinsics, T_world_camera, assignment.cell, _filter_settings(assignment)
            )
            _warm_up(pipeline)
            self._find_background(pipeline)
        elif assignment is not applied:
            settings = _filter_settings(assignment)
            if assignment.cell is not applied.cell or settings != _filter_settings(applied):
                pipeline.adopt(assignment.cell, settings)
            if not np.array_equal(T_world_camera, pipeline.T_world_camera):
                self._move(pipeline, T_world_camera)
        self._pipeline, self._applied = pipeline, assignment
        return pipeline

    def _move(self, pipeline: DepthPipeline, T_world_camera: Transform) -> None:
        """The camera is elsewhere, or is merely known better: then what was learned holds."""
        refined = self._refined is not None and np.array_equal(T_world_camera, self._refined)
        pipeline.move(T_world_camera, refined=refined)
        if refined and pipeline.reference is not None:
            self._store.save(self._place(pipeline), pipeline.reference)
        self._find_background(pipeline)

    def _find_background(self, pipeline: DepthPipeline) -> None:
        """What was learned at this place before, or else begin to learn if the configuration says so."""
        camera = self._camera
        assert camera is not None
        self._stance.begin(place_of(camera.serial, camera.intrinsics.shape, pipeline.T_world_camera))
        self._end_learning("the camera's pose changed meanwhile")
        stored = self._store.load(self._place(pipeline))
        if stored is not None:
            logger.info("using the background learned before, from %d frames", stored.frames)
            pipeline.use(stored)
        elif self._config.learn_background_frames:
            self._learning = _Learning(pipeline.learner(), self._config.learn_background_frames, None)

    def _obey(self, command: Command, pipeline: DepthPipeline) -> None:
        """Do what was asked; what takes more than one frame only begins here."""
        if command.verb == "learn_background":
            frames = self._config.learn_background_frames or LEARN_FRAMES
            self._end_learning("it was asked to begin anew")
            pipeline.use(None)
            self._learning = _Learning(pipeline.learner(), frames, command)
        elif command.verb == "refine":
            if self._refining is not None:
                self.uplink.finish(self._refining.command, "it was asked to begin anew")
            self._refining = _Refining(command, [], pipeline.refiner())
        elif command.verb == "drop_background":
            self._end_learning("it was asked to drop the background")
            pipeline.use(None)
            self._store.drop()
            self.uplink.finish(command)
        elif command.verb != "image":
            self.uplink.finish(command, f"this unit does not know how to {command.verb}")

    def _end_learning(self, outcome: str) -> None:
        """Learn no more; whoever asked for it is told the `outcome`."""
        if self._learning is not None and self._learning.command is not None:
            self.uplink.finish(self._learning.command, outcome)
        self._learning = None

    def _learn(
        self,
        learning: _Learning,
        pipeline: DepthPipeline,
        assignment: Assignment,
        frame: DepthFrame,
        joints: JointEstimate | None,
        stages: Stages,
    ) -> Report:
        """Add a frame to the background; nothing is reported meanwhile."""
        if assignment.cell.robot is not None and joints is None:
            return _troubled(assignment, frame, "learning the background: it waits for the robot's joints")
        pipeline.learn_frame(learning.learner, frame.depth, None if joints is None else joints.positions)
        done = learning.learner.frames
        if done < learning.frames:
            return _troubled(assignment, frame, f"learning the background: frame {done} of {learning.frames}")
        reference = learning.learner.reference()
        pipeline.use(reference)
        self._store.save(self._place(pipeline), reference)
        self._end_learning(DONE)
        logger.info("learned the background from %d frames: %.0f %% of it", done, 100.0 * reference.learned_share)
        return self._report(pipeline, assignment, frame, joints, stages)

    def _report(
        self,
        pipeline: DepthPipeline,
        assignment: Assignment,
        frame: DepthFrame,
        joints: JointEstimate | None,
        stages: Stages,
    ) -> Report:
        """What a frame shows, and whether its camera can be trusted."""
        stages.end("thread")
        if joints is None:
            voxels = pipeline.process(frame.depth, None)
        else:
            voxels = pipeline.process(frame.depth, joints.positions, joint_uncertainty_rad=joints.uncertainty)
        took = pipeline.last
        parts_ns = {"robot": took.expected_ns, "filter": took.points_ns, "density": took.voxels_ns}
        stages.end("check", parts_ns)
        seen, crowd = pipeline.seen(), None
        if len(voxels) > MAX_VOXELS:
            crowd = f"{len(voxels)} obstacle voxels: the {MAX_VOXELS} nearest are reported, the rest counts as not seen"
            voxels, beyond = voxels.nearest(pipeline.T_world_camera[:3, 3], MAX_VOXELS)
            seen = seen.without(beyond)
        health, stance = pipeline.health(), self._judge(pipeline, frame)
        self._gather(pipeline, frame, joints)
        keys = keys_to_bytes(voxels.keys)
        stages.end("report")
        return Report(
            assignment,
            frame.captured_at_ns,
            keys,
            seen,
            Health(
                valid_share=health.valid_share,
                agreeing_share=health.agreeing_share,
                residual_share=health.residual_share,
                static_share=health.static_share,
                process_ms=round(pipeline.last.total_ns / NS_PER_MS, 3),
                frame=frame.frame_number,
                moved=stance.moved or None,
                blind=stance.blind or None,
                warning=stance.warning or self._delay.warning(assignment.settings.joint_delay_s) or crowd,
            ),
            stages.took_ns,
        )

    def _gather(self, pipeline: DepthPipeline, frame: DepthFrame, joints: JointEstimate | None) -> None:
        """Keep the frame without the robot, when the pose is to be refined."""
        refining = self._refining
        if refining is None or len(refining.frames) == REFINE_FRAMES:
            return
        if joints is None and pipeline.cell.robot is not None:
            # Wherever it may stand: it must not be taken for CAD.
            return
        refining.frames.append(pipeline.without_robot(frame.depth, None if joints is None else joints.positions))

    def _judge(self, pipeline: DepthPipeline, frame: DepthFrame) -> Verdict:
        """Whether the camera still stands where it stood, and sees."""
        stance = self._stance
        if not stance.due(frame.captured_at_ns):
            return stance.verdict
        before, verdict = stance.verdict, stance.judge(pipeline.misfit(), pipeline.static_version, frame.captured_at_ns)
        if bool(verdict.reason) != bool(before.reason):
            logger.warning("%s", verdict.reason or "the camera stands where it stood, and sees")
        return verdict

    def _place(self, pipeline: DepthPipeline) -> Place:
        assert self._camera is not None
        return Place(self._camera, pipeline.T_world_camera)

    # ------------------------------------------------------------------ the trace

    def _note(self, report: Report, delivery: Delivery | None) -> None:
        """Remember what became of a report."""
        if self._trace is None or report.captured_at_ns is None:
            return
        lattice = report.assignment.lattice
        self._trace.add(
            TraceRecord(
                report.health.frame,
                report.captured_at_ns,
                report.health.process_ms,
                report.keys,
                lattice.shape,
                lattice.voxel_size_m,
                delivery is not None,
                None if delivery is None else delivery.merged_at_ns,
                None if delivery is None else delivery.sent_at_ns,
                None if delivery is None else delivery.received_at_ns,
                report.stages_ns,
            )
        )

    def _close(self) -> None:
        if self._trace is not None:
            self._trace.close()


def make_source(config: SourceConfig) -> DepthSource:
    """The source that the configuration chose."""
    if isinstance(config, RealsenseSourceConfig):
        return RealsenseSource(config)
    if isinstance(config, RecordedSourceConfig):
        return RecordedSource(config)
    return SimulatedSource(config)


def _is_recording(config: SourceConfig) -> bool:
    """Whether it will not get better by itself: a file stays as it is."""
    if isinstance(config, RealsenseSourceConfig):
        return config.recording is not None
    return isinstance(config, RecordedSourceConfig)


def _warm_up(pipeline: DepthPipeline) -> None:
    """Have every kernel compiled, by a frame that shows nothing."""
    robot = pipeline.cell.robot
    joints = None if robot is None else np.zeros(robot.joint_count)
    pipeline.process(np.zeros(pipeline.intrinsics.shape, np.uint16), joints)
    pipeline.health()
    pipeline.misfit()
    pipeline.seen()
    # What is there now stays; without this, each full collection looks through it, and a frame waits 0.1 s.
    gc.collect()
    gc.freeze()


def _troubled(assignment: Assignment, frame: DepthFrame, trouble: str) -> Report:
    """A report that only says what is wrong: no voxels, nothing seen."""
    health = Health(frame=frame.frame_number, trouble=trouble[:MAX_TEXT])
    return Report(assignment, frame.captured_at_ns, health=health)


def _filter_settings(assignment: Assignment) -> FilterSettings:
    """The part of the settings that the pipeline works with."""
    return FilterSettings.model_validate(assignment.settings.model_dump(include=set(FilterSettings.model_fields)))


def _boot_id() -> str:
    """Changes when the machine's monotonic clock starts anew."""
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""
