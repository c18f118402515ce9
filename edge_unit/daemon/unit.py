# SPDX-License-Identifier: Apache-2.0
"""The daemon, which connects source, pipeline and uplink.

A thread processes one frame after the other, while the event loop exchanges messages with the master. The master's
changes of settings, cell or pose are an `Assignment`, which is applied between two frames. Each report has the
assignment of its frame, so the master never merges it under another lattice, cell or pose.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import logging
from contextlib import aclosing, suppress

from edge_unit.calibration.board_scan import BoardSearch
from edge_unit.config import UnitConfig
from edge_unit.daemon.background_learning import BackgroundLearning
from edge_unit.daemon.background_store import BackgroundStore
from edge_unit.daemon.calibration_task import localise
from edge_unit.daemon.command_batch import CommandBatch, put_back
from edge_unit.daemon.frame_limiter import FrameLimiter
from edge_unit.daemon.frame_processor import FrameProcessor
from edge_unit.daemon.image_requests import NO_POSE, ImageRequests
from edge_unit.daemon.joint_lookup import FrameJoints
from edge_unit.daemon.pipeline_manager import AssignedPipeline
from edge_unit.daemon.refinement_task import RefinementTask
from edge_unit.daemon.report import troubled
from edge_unit.daemon.task_group import TaskGroup
from edge_unit.daemon.unit_status import UnitStatus
from edge_unit.daemon.warm_up import warm_up_kernels
from edge_unit.monitoring import CameraStatus, PoseMonitor, StageTimer, StallDetector, Trace, boot_id
from edge_unit.source_factory import is_recording
from edge_unit.sources.frame import DepthFrame, DepthSource
from edge_unit.sources.status import ReportsStatus
from edge_unit.uplink.assignment import Assignment, Delivery, Report, Trouble
from edge_unit.uplink.cell_cache import CellCache
from edge_unit.uplink.client import MasterClient
from edge_unit.uplink.master_discovery import MasterSearch
from edge_unit.uplink.uplink import Uplink
from shared.errors import InputError, SourceError
from shared.messages import Command, Outcome
from shared.transforms import Transform
from shared.waiting import LOOP_CLOCK, Clock, done_within, sleep

logger = logging.getLogger(__name__)

REOPEN_MIN_S = 0.2
REOPEN_MAX_S = 5.0
"""Pauses between attempts to open a camera that delivers no frames."""

WARM_UP_S = 5.0
"""Time for a warm-up that loads the kernels from disk, on a busy machine."""

FRAME_S_MAX = 5.0
"""Limit of the stall detector for one frame without preparation: a hundred times the duration on the slowest board."""

PREPARE_S_MAX = 240.0
"""Limit of the stall detector if kernels are compiled and the expected depth of a cell is drawn, on a board that has
neither cached."""

DRAIN_S = 2.0
"""Timeout for the last frame of a recording to reach the master."""


class Unit:
    """A unit with one camera and one master. `run` ends when it is cancelled or when a recording ends."""

    def __init__(
        self,
        config: UnitConfig,
        source: DepthSource,
        client: MasterClient | None = None,
        clock: Clock = LOOP_CLOCK,
    ) -> None:
        """Read and open files. Call it outside the event loop.

        `clock` is the clock of the source's `captured_at_ns`. Without `client` the unit makes one and searches for the
        master.

        Raises:
            ConfigError: the trace cannot be written, or the configured pose cannot be read.
        """
        self._config = config
        self._source = source
        self._clock = clock
        master_search = None
        if client is None:
            master_search = MasterSearch(config, clock)
            client = MasterClient(config.master_url, config.read_token, config.source_address, tls=config.tls())
        self._client = client
        self.uplink = Uplink(
            client,
            CellCache(config.state_dir / "cell"),
            f"edge-unit {importlib.metadata.version('cellwatch')}",
            boot_id(),
            self._note,
            master_search,
            clock,
        )
        self._camera = CameraStatus(config, self.uplink)
        self._trace = None if config.trace_path is None else Trace(config.trace_path)
        self._search = BoardSearch(source, config.board_stream, clock)
        self._processor = self._make_processor()
        self._tasks = TaskGroup()
        self._image_requests = ImageRequests(self.uplink, self._processor.assigned, self._tasks)
        self._stall_detector = StallDetector(clock)
        self._warm_up: asyncio.Task[None] | None = None
        self._limiter = FrameLimiter(config.fps_max)
        self._status = UnitStatus(clock)

    def _make_processor(self) -> FrameProcessor:
        config, finish = self._config, self.uplink.finish
        pose_monitor = PoseMonitor(config.state_dir)
        learning = BackgroundLearning(BackgroundStore(config.state_dir), config.learn_background_frames, finish)
        assigned = AssignedPipeline(learning, pose_monitor)
        refinement = RefinementTask(self.uplink, assigned, pose_monitor)
        return FrameProcessor(finish, assigned, learning, refinement, pose_monitor, FrameJoints(self.uplink))

    async def run(self) -> None:
        """Process frames and report them.

        Raises:
            ConfigError: there is no token.
            SourceError: a recording is missing or malformed.
        """
        async with self._client:
            tasks = [asyncio.create_task(self.uplink.run()), asyncio.create_task(self._process_frames())]
            if self.uplink.search is not None:
                tasks.append(asyncio.create_task(self.uplink.search.run()))
            if isinstance(self._source, ReportsStatus):
                tasks.append(asyncio.create_task(self._camera.follow(self._source)))
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in tasks:
                    task.cancel()
                results = await asyncio.gather(*tasks, return_exceptions=True)
                await self._tasks.end()
                if self._trace is not None:
                    await asyncio.to_thread(self._trace.close)
            for result in results:
                if isinstance(result, Exception):
                    raise result

    # ------------------------------------------------------------------ status

    def status(self) -> str:
        """Return one line on the camera, the frames per second since the last call, and the master."""
        trouble = self.uplink.camera_state.trouble
        line = self._status.line(None if trouble is None else trouble.sentence)
        return f"{line}; {self.uplink.status_text}"

    def stuck(self) -> str | None:
        """Return the stalled step as a sentence, or None. A wait for a camera or a master is no stall."""
        return self._stall_detector.stuck()

    def _note(self, report: Report, delivery: Delivery | None) -> None:
        if self._trace is not None:
            self._trace.note(report, delivery)

    # ------------------------------------------------------------------ the camera

    async def _process_frames(self) -> None:
        """Process frames until a recording ends. A camera that fails is opened again."""
        retry_s = REOPEN_MIN_S
        while True:
            try:
                await self._open()
                async with aclosing(self._source.frames()) as frames:
                    async for frame in frames:
                        retry_s = REOPEN_MIN_S
                        await self._take(frame)
                await self._end()
                return
            except SourceError as error:
                if is_recording(self._config.source):
                    raise
                await self._camera.failed(error)
            finally:
                await self._source.close()
            await sleep(retry_s, self._clock)
            retry_s = min(2.0 * retry_s, REOPEN_MAX_S)

    async def _open(self) -> None:
        if self._warm_up is None:
            self._warm_up = asyncio.create_task(asyncio.to_thread(self._run_warm_up))
        camera = await self._source.open()
        # A unit that registers is live with the next frame. But if it must compile first, it registers before that,
        # so the master knows it.
        await done_within(WARM_UP_S, self._warm_up, self._clock)
        self._processor.assigned.open(camera)
        await self._camera.opened(camera)
        await asyncio.gather(self.uplink.assigned.wait(), self._warm_up)
        assignment = self.uplink.assignment
        if assignment is not None and assignment.T_world_camera is not None:
            # Before the camera delivers frames, so that no frame waits for the one-time compilation and drawing.
            # An error is not raised here: each frame reports it until the master changes the cause.
            with suppress(InputError), self._stall_detector.working("preparing for frames", PREPARE_S_MAX):
                await asyncio.to_thread(self._processor.assigned.prepare, assignment, assignment.T_world_camera)

    def _run_warm_up(self) -> None:
        with self._stall_detector.working("compiling the kernels", PREPARE_S_MAX):
            warm_up_kernels()

    async def _end(self) -> None:
        """End after the last frame of a recording."""
        await self.uplink.drained(DRAIN_S)
        if self._processor.learning.progress is None:
            logger.info("the recording has ended")
        else:
            logger.warning(
                "the recording ended after %d of the %d frames to be learned", *self._processor.learning.progress
            )

    # ------------------------------------------------------------------ a frame

    async def _take(self, frame: DepthFrame) -> None:
        """Handle one frame by its time, the master's assignment and the master's commands."""
        if not self._limiter.due(frame.captured_at_ns):
            return
        assignment = self.uplink.assignment or self._processor.assigned.assignment
        if assignment is None:
            return
        batch = CommandBatch.take(self.uplink.commands)
        if batch.calibrations:
            put_back(self.uplink.commands, (*batch.changes, *batch.images))
            # The frame is older than the search for the board, and its memory may be reused afterwards.
            outcome = await localise(self._search, self.uplink, assignment, frame)
            self._finish(batch.calibrations, outcome)
        elif assignment.T_world_camera is None:
            await self._search_pose(assignment, frame, batch)
        else:
            await self._filter(assignment, assignment.T_world_camera, frame, batch)

    async def _search_pose(self, assignment: Assignment, frame: DepthFrame, batch: CommandBatch) -> None:
        """Report that the camera's pose is not known, and search for the board from time to time."""
        self._processor.assigned.pipeline = None
        self._finish(batch.changes, Outcome("refused", NO_POSE))
        found = self._search.outcome
        trouble = Trouble("board", f"searching for the board: {found}") if found else None
        report = troubled(assignment, frame, trouble)
        self._status.note_trouble(report.health.trouble or NO_POSE)
        self.uplink.offer(report)
        await self._image_requests.show(batch.images, frame, None)
        can_localise = self._config.localise and assignment.cell.board is not None
        if can_localise and self._search.due:
            await localise(self._search, self.uplink, assignment, frame)

    async def _filter(
        self, assignment: Assignment, T_world_camera: Transform, frame: DepthFrame, batch: CommandBatch
    ) -> None:
        """Process the frame and offer the report. Later steps do not delay it."""
        stages = StageTimer(frame.captured_at_ns, self._clock)
        stages.end("source")
        joints = await self._processor.joints.at(assignment, frame)
        stages.end("joints")
        prepared = assignment is self._processor.assigned.assignment and not batch.changes and not batch.images
        with self._stall_detector.working(f"frame {frame.frame_number}", FRAME_S_MAX if prepared else PREPARE_S_MAX):
            if self._trace is not None:
                await asyncio.to_thread(self._trace.flush)
            report = await asyncio.to_thread(
                self._processor.process, assignment, T_world_camera, frame, joints, batch.changes, stages
            )
        self._status.note_frame(report.health.trouble)
        self.uplink.offer(report)
        await self._image_requests.show(batch.images, frame, joints)
        for task in self._processor.afterwards(frame, joints, report):
            self._tasks.start(task)

    def _finish(self, commands: list[Command], outcome: Outcome) -> None:
        for command in commands:
            self.uplink.finish(command, outcome)
