# SPDX-License-Identifier: Apache-2.0
"""The daemon: source, pipeline and uplink together.

Frames are processed one after the other in a worker thread, while the event loop talks to the master. Settings, cell
and pose from the master form an `Assignment`, which is applied between two frames. A report carries the assignment that
it was made with, so that nothing is merged under another lattice, cell or pose.
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
"""Pause between attempts to open a camera that delivers no frames."""

REHEARSAL_S = 5.0
"""Time to read kernels from disk, on a busy machine."""

FRAME_S_MAX = 5.0
"""Time limit of one frame without preparation: a hundred times that of the slowest board."""

PREPARE_S_MAX = 240.0
"""Time limit of a frame with preparation: kernels are compiled and the cell is drawn, on a board."""

DRAIN_S = 2.0
"""Time for the last frame of a recording to reach the master."""


class Unit:
    """A unit with one camera and one master; `run` lasts until it is cancelled, or until a recording ends."""

    def __init__(
        self,
        config: UnitConfig,
        source: DepthSource,
        client: MasterClient | None = None,
        clock: Clock = LOOP_CLOCK,
    ) -> None:
        """Read and open files, so construct it before the event loop runs.

        `clock` is the clock of the source's `captured_at_ns`. Without `client` the unit makes one and searches for the
        master.

        Raises:
            ConfigError: the trace cannot be written, or the configured pose cannot be read.
        """
        self._config = config
        self._source = source
        self._clock = clock
        masters = None
        if client is None:
            masters = MasterSearch(config, clock)
            client = MasterClient(config.master_url, config.read_token, config.source_address, tls=config.tls())
        self._client = client
        self.uplink = Uplink(
            client,
            CellCache(config.state_dir / "cell"),
            f"edge-unit {importlib.metadata.version('cellwatch')}",
            boot_id(),
            self._note,
            masters,
            clock,
        )
        self._camera = CameraStatus(config, self.uplink)
        self._trace = None if config.trace_path is None else Trace(config.trace_path)
        self._search = BoardSearch(source, config.board_stream, clock)
        self._work = self._frame_work()
        self._tasks = TaskGroup()
        self._image_requests = ImageRequests(self.uplink, self._work.assigned, self._tasks)
        self._progress = StallDetector(clock)
        self._rehearsal: asyncio.Task[None] | None = None
        self._limiter = FrameLimiter(config.fps_max)
        self._status = UnitStatus(clock)

    def _frame_work(self) -> FrameProcessor:
        config, finish = self._config, self.uplink.finish
        monitor = PoseMonitor(config.state_dir)
        learning = BackgroundLearning(BackgroundStore(config.state_dir), config.learn_background_frames, finish)
        assigned = AssignedPipeline(learning, monitor)
        refining = RefinementTask(self.uplink, assigned, monitor)
        return FrameProcessor(finish, assigned, learning, refining, monitor, FrameJoints(self.uplink))

    async def run(self) -> None:
        """Run the unit.

        Raises:
            ConfigError: there is no token.
            SourceError: a recording is missing or malformed.
        """
        async with self._client:
            tasks = [asyncio.create_task(self.uplink.run()), asyncio.create_task(self._watch())]
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
        """Status in one line: camera, frames a second since the last call, master."""
        trouble = self.uplink.camera_state.trouble
        line = self._status.line(None if trouble is None else trouble.sentence)
        return f"{line}; {self.uplink.status_text}"

    def stuck(self) -> str | None:
        """The work that hangs and does not end by itself; empty while the unit waits for a camera or a master."""
        return self._progress.stuck()

    def _note(self, report: Report, delivery: Delivery | None) -> None:
        if self._trace is not None:
            self._trace.note(report, delivery)

    # ------------------------------------------------------------------ the camera

    async def _watch(self) -> None:
        """Take frames until there are no more; a camera that fails is opened again."""
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
        if self._rehearsal is None:
            self._rehearsal = asyncio.create_task(asyncio.to_thread(self._rehearse))
        camera = await self._source.open()
        # A registered unit is live with its next frame, but one that must compile first registers before that.
        await done_within(REHEARSAL_S, self._rehearsal, self._clock)
        self._work.assigned.open(camera)
        await self._camera.opened(camera)
        await asyncio.gather(self.uplink.assigned.wait(), self._rehearsal)
        assignment = self.uplink.assignment
        if assignment is not None and assignment.T_world_camera is not None:
            # Before the camera delivers, so that no frame waits for compiling and drawing.
            # A failure is reported with each frame, because the master may change its cause.
            with suppress(InputError), self._progress.working("preparing for frames", PREPARE_S_MAX):
                await asyncio.to_thread(self._work.assigned.prepare, assignment, assignment.T_world_camera)

    def _rehearse(self) -> None:
        with self._progress.working("compiling the kernels", PREPARE_S_MAX):
            warm_up_kernels()

    async def _end(self) -> None:
        """Note the end of a recording."""
        await self.uplink.drained(DRAIN_S)
        if self._work.learning.progress is None:
            logger.info("the recording has come to its end")
        else:
            logger.warning("the recording ended after %d of the %d frames to be learned", *self._work.learning.progress)

    # ------------------------------------------------------------------ a frame

    async def _take(self, frame: DepthFrame) -> None:
        """Handle one frame as its time, the assignment and the commands require."""
        if not self._limiter.due(frame.captured_at_ns):
            return
        assignment = self.uplink.assignment or self._work.assigned.assignment
        if assignment is None:
            return
        batch = CommandBatch.take(self.uplink.commands)
        if batch.calibrations:
            put_back(self.uplink.commands, (*batch.changes, *batch.images))
            # The frame is older than the search, and its memory may be reused afterwards.
            outcome = await localise(self._search, self.uplink, assignment, frame)
            self._finish(batch.calibrations, outcome)
        elif assignment.T_world_camera is None:
            await self._look_for_pose(assignment, frame, batch)
        else:
            await self._filter(assignment, assignment.T_world_camera, frame, batch)

    async def _look_for_pose(self, assignment: Assignment, frame: DepthFrame, batch: CommandBatch) -> None:
        """Report that the camera's pose is not known, and search for the board from time to time."""
        self._work.assigned.pipeline = None
        self._finish(batch.changes, Outcome("refused", NO_POSE))
        seen = self._search.outcome
        searching = Trouble("board", f"searching for the board: {seen}") if seen else None
        report = troubled(assignment, frame, searching)
        self._status.note_trouble(report.health.trouble or NO_POSE)
        self.uplink.offer(report)
        await self._image_requests.show(batch.images, frame, None)
        wanted = self._config.localise and assignment.cell.board is not None
        if wanted and self._search.due:
            await localise(self._search, self.uplink, assignment, frame)

    async def _filter(
        self, assignment: Assignment, T_world_camera: Transform, frame: DepthFrame, batch: CommandBatch
    ) -> None:
        """Process the frame and send the report; the tasks that follow do not delay it."""
        stages = StageTimer(frame.captured_at_ns, self._clock)
        stages.end("source")
        joints = await self._work.joints.at(assignment, frame)
        stages.end("joints")
        prepared = assignment is self._work.assigned.assignment and not batch.changes and not batch.images
        with self._progress.working(f"frame {frame.frame_number}", FRAME_S_MAX if prepared else PREPARE_S_MAX):
            if self._trace is not None:
                await asyncio.to_thread(self._trace.flush)
            report = await asyncio.to_thread(
                self._work.process, assignment, T_world_camera, frame, joints, batch.changes, stages
            )
        self._status.note_frame(report.health.trouble)
        self.uplink.offer(report)
        await self._image_requests.show(batch.images, frame, joints)
        for task in self._work.afterwards(frame, joints, report):
            self._tasks.start(task)

    def _finish(self, commands: list[Command], outcome: Outcome) -> None:
        for command in commands:
            self.uplink.finish(command, outcome)
