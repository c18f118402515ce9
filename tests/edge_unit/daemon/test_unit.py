# SPDX-License-Identifier: Apache-2.0
"""The daemon with a real pipeline and a real master, both in this process, by a clock that the tests set.

The camera shows what a test wants. Frames are worked on in threads, so a test waits for them by the real clock; but
nothing here is measured by it, and no wait of the unit's ends by it.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.calibration.board_layout import BoardLayout
from edge_unit.calibration.board_scan import RETRY_MIN_S
from edge_unit.config import PoseConfig, UnitConfig
from edge_unit.daemon import report as reporting_module
from edge_unit.daemon import unit as unit_module
from edge_unit.daemon.frame_processor import FrameProcessor
from edge_unit.daemon.joint_lookup import FrameJoints
from edge_unit.daemon.refinement_task import REFINE_FRAMES
from edge_unit.daemon.unit import FRAME_S_MAX, Unit
from edge_unit.daemon.warm_up import warm_up_kernels
from edge_unit.monitoring import read_trace
from edge_unit.sources.frame import CameraInfo, DepthFrame
from edge_unit.sources.image import ImageFrame, ImageInfo, ImageStream
from edge_unit.sources.simulated import SimulatedSourceConfig
from edge_unit.uplink.client import MasterClient
from edge_unit.uplink.outbox import HEARTBEAT_S
from edge_unit.uplink.uplink import RETRY_MAX_S
from master_server.api import image_requests
from master_server.api.routes import images, robot, units, update
from master_server.app import make_app
from master_server.core import Master
from master_server.core import units as core_units
from master_server.core.master import MapView
from master_server.core.units import Slot
from master_server.security import Access
from shared.camera import Intrinsics
from shared.cell import Board
from shared.clock import monotonic_ns
from shared.errors import SourceError
from shared.messages import Command, CommandRow, JointsRequest, OutcomeCode, Progress, UnitRow, Verb
from shared.settings import Settings
from shared.transforms import from_xyz_rpy, inverse
from shared.waiting import LOOP_CLOCK, Clock
from simulation.cameras.board_picture import BoardPicture
from tests.edge_unit import scenes
from tests.master_server.fakes import cell as make_cell
from tests.master_server.fakes import master as make_master
from tests.set_clock import MS, S, SetClock

TOKEN = "unit-token-0123456789"
IP = "10.0.0.1"
# So few pixels with the noise of a real camera: its imagers stand a metre apart.
CAMERA = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5, stereo_baseline_m=1.0)
FAR_MM = 5000

MASTER_MODULES = (images, robot, units, update)
"""Of the master's, those that read the time for a unit."""

HEARTBEAT_NS = round(HEARTBEAT_S * S)
RETRY_NS = round(1.2 * RETRY_MAX_S * S)
"""The longest wait of the uplink."""

FRAME_NS = 33 * MS

# Above the box of 1 m, 2 m, 0.5 m, looking straight down at its middle.
ABOVE = PoseConfig(xyz=(0.5, 1.0, 1.5), rpy_deg=(180.0, 0.0, 0.0))
BESIDE = PoseConfig(xyz=(0.5, 1.5, 1.5), rpy_deg=(180.0, 0.0, 0.0))


PATIENCE_S = 60
"""For a frame on a busy machine; by the real clock, and so never measured."""


def patch(depth_mm: int, column: int = 24) -> NDArray[np.uint16]:
    """A square of 16 pixels before a floor that is far outside the cell."""
    depth = np.full(CAMERA.shape, FAR_MM, np.uint16)
    depth[16:32, column : column + 16] = depth_mm
    return depth


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """In a checkout that is new, kernels are compiled here and not while a test counts seconds."""
    warm_up_kernels()


class FakeSource:
    """Delivers what a test puts into it, a frame's period later; an exception is raised, None is the end."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.queue: asyncio.Queue[NDArray[np.uint16] | Exception | None] = asyncio.Queue()
        self.serial = "A"
        self.camera = CAMERA
        self.opened = 0
        self.closed = 0
        self.number = 0
        self.joints: NDArray[np.float64] | None = None

    async def open(self) -> CameraInfo:
        self.opened += 1
        return CameraInfo(self.serial, "fake", self.camera)

    async def frames(self) -> AsyncGenerator[DepthFrame, None]:
        while True:
            item = await self.queue.get()
            if item is None:
                return
            if isinstance(item, Exception):
                raise item
            if isinstance(self.clock, SetClock):
                self.clock.go_to(self.clock.now + FRAME_NS)
            yield DepthFrame(item, self.clock.now_ns(), self.number, self.joints)
            self.number += 1

    async def close(self) -> None:
        self.closed += 1


class Bench:
    """One master, one unit, one source."""

    def __init__(self, folder: Path, with_robot: bool = False, real_clock: bool = False, **config: Any) -> None:
        self.clock = SetClock()
        self.unit_clock: Clock = LOOP_CLOCK if real_clock else self.clock
        self.answered = 0
        self.source = FakeSource(self.unit_clock)
        self.serve(make_master(with_robot, stale_after_s=60.0))
        fields = {"T_world_camera": ABOVE, "state_dir": folder, "token": TOKEN, **config}
        # Which source is configured decides only what happens when it fails.
        self.config = UnitConfig(source=SimulatedSourceConfig(), **fields)
        self.unit = self.make_unit()

    def serve(self, master: Master) -> None:
        """From now on this master answers."""
        self.master = master
        self.app = make_app(master, Access(TOKEN.encode(), b"operator-token-0123456789"))

    def make_unit(self) -> Unit:
        transport = httpx.ASGITransport(app=self._answer, client=(IP, 40_000))
        client = MasterClient("http://master", lambda: TOKEN, transport=transport)
        return Unit(self.config, self.source, client, self.unit_clock)

    async def _answer(self, *call: Any) -> None:
        await self.app(*call)
        self.answered += 1

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[asyncio.Task[None]]:
        with pytest.MonkeyPatch.context() as patch:
            for module in MASTER_MODULES:
                patch.setattr(module, "monotonic_ns", self.unit_clock.now_ns)
            self.task = task = asyncio.create_task(self.unit.run())
            try:
                yield task
            finally:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task

    def show(self, depth: NDArray[np.uint16] | Exception | None) -> None:
        self.source.queue.put_nowait(depth)

    def row(self) -> UnitRow | None:
        rows = self.master.units(self.unit_clock.now_ns())
        return rows[0] if rows else None

    def voxels(self) -> set[tuple[int, ...]]:
        view = self.view()
        return {tuple(index) for index in view.lattice.indices(view.keys).tolist()}

    def view(self) -> MapView:
        return self.master.view(self.unit_clock.now_ns())

    def ask(self, verb: Verb) -> Command:
        """Ask unit 1 for something, as an operator does."""
        return self.master.send_command(1, verb, self.unit_clock.now_ns())

    async def until(self, look: Callable[[], Any], what: str, *, beating: bool = False) -> Any:
        """Wait until threads and requests have come so far that `look` finds something.

        The clock stands meanwhile; with `beating` it goes on from one wait of the uplink to the next.
        """
        deadline_ns = monotonic_ns() + PATIENCE_S * S
        while not (found := look()):
            if self.task.done():
                await self.task
            assert monotonic_ns() < deadline_ns, f"{what}: {self.row()}"
            due_ns = self.clock.due_ns() if beating else None
            if due_ns is not None and due_ns <= self.clock.now + RETRY_NS:
                self.clock.step()
            await asyncio.sleep(0.002)
        return found

    async def beat(self) -> None:
        """Let the uplink's heartbeat come, and wait until it has followed the answer and waits for the next."""
        await self.until(lambda: self.clock.due_ns() is not None, "the wait for a heartbeat")
        before = self.answered
        self.clock.go_to(self.clock.now + HEARTBEAT_NS)
        await self.until(lambda: self.answered > before and self.clock.due_ns() is not None, "a heartbeat")

    async def pass_time(self, seconds: float) -> None:
        """Let so much time pass, from one call of the clock to the next."""
        end_ns = self.clock.now + round(seconds * S)
        while True:
            await self.until(lambda: self.clock.due_ns() is not None, "a wait of the unit's")
            due_ns = self.clock.due_ns()
            if due_ns is None or due_ns > end_ns:
                break
            self.clock.step()
        self.clock.go_to(end_ns)

    async def ask_and_hear(self, verb: Verb) -> Command:
        """Ask unit 1 for something, and wait until it has heard of it."""
        command = self.ask(verb)
        await self.beat()
        assert not self.unit.uplink.commands.empty()
        return command

    async def until_state(self, state: str) -> UnitRow:
        found = await self.until(lambda: (row := self.row()) is not None and row.state == state and row, state)
        assert isinstance(found, UnitRow)
        return found


async def test_from_frame_to_map(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path)
    async with bench.running():
        bench.show(patch(1225))
        row = await bench.until_state("live")
        # 1.225 m below the camera, in the middle: 0.33 m wide.
        assert {index[2] for index in bench.voxels()} == {5}
        assert 36 <= len(bench.voxels()) <= 64
        assert row.voxels == len(bench.voxels())
        assert row.health.valid_share == 1.0
        assert row.process_ms > 0.0
        assert bench.view().complete
        bench.show(patch(FAR_MM))
        await bench.until(lambda: not bench.voxels(), "an empty map")
        assert bench.view().complete
    assert bench.source.closed >= 1


async def test_of_too_many_voxels_the_nearest_are_reported_and_the_rest_is_not_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Two plates at different heights: the nearer one is 1.05 m below the camera, at z of 0.45 m.
    depth = patch(1225)
    depth[:, :16] = 1050
    bench = await asyncio.to_thread(Bench, tmp_path)
    async with bench.running():
        bench.show(depth)
        row = await bench.until_state("live")
        everything, all_seen = bench.voxels(), bench.master.seen_by(bench.clock.now)
        assert row.reason == ""
        near = {index for index in everything if index[2] == 9}
        assert 20 <= len(near) < len(everything)
        monkeypatch.setattr(reporting_module, "MAX_VOXELS", len(near))
        bench.show(depth)
        warning = (
            f"{len(everything)} obstacle voxels: the {len(near)} nearest are reported, the rest counts as not seen"
        )
        row = await bench.until(lambda: (row := bench.row()) and row.reason and row, "a warning")
        assert (row.state, row.reason) == ("live", warning)
        assert bench.voxels() == near
        seen = bench.master.seen_by(bench.clock.now)
        assert (seen <= all_seen).all()
        for x, y, z in everything - near:
            assert seen[x // 2, y // 2, z // 2] == 0
        assert bench.view().complete


async def test_a_frame_that_hangs_is_told_and_waiting_for_a_camera_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path)
    entered, release = threading.Event(), threading.Event()
    async with bench.running():
        bench.show(patch(1225))
        await bench.until_state("live")
        assert "live" in bench.unit.status()
        assert "unit 1 at http://master" in bench.unit.status()
        bench.show(SourceError("it was unplugged"))
        await bench.until(lambda: "it was unplugged" in bench.unit.status(), "a camera that is gone")
        await bench.pass_time(2.0 * FRAME_S_MAX)
        assert bench.unit.stuck() is None
        await bench.until(lambda: bench.source.opened >= 2, "a camera that is opened again")
        bench.show(patch(1225))
        await bench.until(lambda: (row := bench.row()) and row.health.frame == 1, "a frame")
        monkeypatch.setattr(FrameProcessor, "process", lambda *_: entered.set() or release.wait(PATIENCE_S))
        bench.show(patch(1225))
        await bench.until(entered.is_set, "a frame that is begun")
        bench.clock.go_to(bench.clock.now + round(FRAME_S_MAX * S))
        assert bench.unit.stuck() is None
        bench.clock.go_to(bench.clock.now + 1 * S)
        stuck = bench.unit.stuck()
        assert stuck is not None
        assert stuck.startswith(f"frame 2 has not finished for {FRAME_S_MAX + 1.0:.0f} s")
        release.set()


async def test_what_is_seen_goes_along_only_when_it_changed(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path)
    reports = []
    update = MasterClient.update

    async def spy(client: MasterClient, request: Any) -> Any:
        # A heartbeat before the first frame is done tells of no frame, and of nothing that took time.
        if request.health.process_ms > 0.0:
            reports.append((request.health.frame, request.seen is not None))
        return await update(client, request)

    with pytest.MonkeyPatch.context() as monkey:
        monkey.setattr(MasterClient, "update", spy)
        async with bench.running():
            for number, depth in enumerate((patch(FAR_MM), patch(FAR_MM), patch(1225), patch(1225))):
                bench.show(depth)
                await bench.until(lambda number=number: (number, False) in reports or (number, True) in reports, "sent")
    assert [seen for frame, seen in reports if frame in (0, 2)][:1] == [True]
    changed = [frame for frame, seen in reports if seen]
    assert changed == [0, 2]


async def test_settings_cell_and_pose_change_while_it_runs(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path)
    async with bench.running() as task:
        bench.show(patch(1225))
        await bench.until_state("live")
        before = bench.voxels()
        bench.master.change_settings({"voxel_size_m": 0.1})
        assert bench.voxels() == set()
        await bench.beat()
        bench.show(patch(1225))
        await bench.until_state("live")
        coarse = bench.voxels()
        assert 0 < len(coarse) < len(before)
        assert {index[2] for index in coarse} == {2}

        bench.master.set_pose(1, _matrix(BESIDE), "operator", None)
        await bench.beat()
        bench.show(patch(1225))
        await bench.until_state("live")
        assert {(x, y + 5, z) for x, y, z in coarse} == bench.voxels()
        assert not task.done()


def _matrix(pose: PoseConfig) -> Any:
    return tuple(tuple(row) for row in pose.transform().tolist())


async def test_without_a_pose_it_waits_for_one(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path, T_world_camera=None)
    async with bench.running():
        bench.show(patch(1225))
        await bench.until(lambda: (row := bench.row()) and row.age_s is not None, "a frame of an uncalibrated unit")
        await bench.until_state("uncalibrated")
        assert bench.voxels() == set()
        bench.master.set_pose(1, _matrix(ABOVE), "operator", None)
        await bench.beat()
        bench.show(patch(1225))
        await bench.until_state("live")
        assert bench.voxels()


async def test_a_camera_that_fails_is_opened_again_and_its_trouble_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unit_module, "REOPEN_MIN_S", 0.3)
    bench = await asyncio.to_thread(Bench, tmp_path)
    async with bench.running():
        bench.show(patch(1225))
        await bench.until_state("live")
        bench.show(SourceError("unplugged"))
        await bench.until(lambda: bench.source.closed == 1, "the camera closed")
        await bench.beat()
        row = await bench.until_state("blind")
        assert row.cause is not None
        assert row.cause.code == "camera"
        assert "unplugged" in row.reason
        assert bench.source.opened == 1
        await bench.pass_time(0.3)
        bench.show(patch(1225))
        await bench.until_state("live")
        assert bench.source.opened == 2


async def test_another_camera_registers_anew_and_its_pose_is_void(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path)
    async with bench.running():
        bench.show(patch(1225))
        await bench.until_state("live")
        # So long the master holds another camera at this address for another unit.
        bench.master.change_settings({"stale_after_s": 0.5})
        bench.config = bench.config.model_copy(update={"T_world_camera": None})
        bench.unit._camera.known_pose = None
        bench.source.serial = "B"
        bench.show(SourceError("unplugged"))
        await bench.until(lambda: bench.source.closed == 1, "the camera closed")
        row = await bench.until(
            lambda: (row := bench.row()) and row.state == "uncalibrated" and row, "another unit", beating=True
        )
        assert row.serial == "B"
        assert "changed from A to B" in row.reason


async def test_a_forgotten_unit_comes_back(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path)
    async with bench.running():
        bench.show(patch(1225))
        await bench.until_state("live")
        bench.master.forget(1)
        bench.show(patch(1225))
        row = await bench.until(
            lambda: (row := bench.row()) and row.arrival_age_s is not None and row, "registered", beating=True
        )
        assert row.id == 2
        bench.show(patch(1225))
        await bench.until_state("live")


async def test_another_master_never_gets_voxels_of_the_first_ones_lattice(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path)
    async with bench.running():
        bench.show(patch(1225))
        await bench.until_state("live")
        # All version numbers begin at 1 again, and mean another lattice.
        bench.serve(make_master(voxel_size_m=0.1, stale_after_s=60.0))
        await bench.until(bench.row, "registered", beating=True)
        for _ in range(3):
            await bench.beat()
        assert bench.voxels() == set()
        bench.show(patch(1225))
        await bench.until_state("live")
        assert {index[2] for index in bench.voxels()} == {2}


async def test_joints_of_the_frames_time_reach_the_pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path, with_robot=True)
    used: list[Any] = []
    report = FrameProcessor._report

    def spy(work: Any, pipeline: Any, assignment: Any, frame: Any, joints: Any, stages: Any) -> Any:
        used.append(joints)
        return report(work, pipeline, assignment, frame, joints, stages)

    monkeypatch.setattr(FrameProcessor, "_report", spy)
    async with bench.running():
        bench.show(patch(FAR_MM))
        await bench.until(lambda: used, "a frame without joints")
        assert used[-1] is None
        for step in range(3):
            bench.master.put_joints(JointsRequest(positions=(0.5, 0.1 * step)), bench.clock.now)
            bench.clock.go_to(bench.clock.now + 10 * MS)
        bench.show(patch(FAR_MM))
        await bench.until(lambda: len(used) == 2, "a frame with joints")
        assert used[-1].positions[0] == pytest.approx(0.5)
        assert used[-1].uncertainty[0] < used[-1].uncertainty[1]
        bench.source.joints = np.array([0.25, -0.25])
        bench.show(patch(FAR_MM))
        await bench.until(lambda: len(used) == 3, "a frame with joints of its own")
        assert used[-1].positions.tolist() == [0.25, -0.25]


async def test_joints_whose_times_are_late_are_looked_up_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot turns at 1 rad/s; the delay is told while the unit runs."""
    bench = await asyncio.to_thread(Bench, tmp_path, with_robot=True)
    ahead_s: list[float | None] = []
    report = FrameProcessor._report
    began_ns = bench.clock.now

    def turned(at_ns: int) -> float:
        return (at_ns - began_ns) / S

    def spy(work: Any, pipeline: Any, assignment: Any, frame: Any, joints: Any, stages: Any) -> Any:
        ahead_s.append(None if joints is None else joints.positions[1] - turned(frame.captured_at_ns))
        return report(work, pipeline, assignment, frame, joints, stages)

    def has_more_than(count: int) -> bool:
        return len(ahead_s) > count

    async def ahead() -> float:
        """Of a frame for which joints are known: the first may come long after them, while kernels are compiled."""
        while True:
            count, at_ns = len(ahead_s), bench.clock.now
            request = JointsRequest(positions=(0.0, turned(at_ns)), velocities=(0.0, 1.0), at_ns=at_ns)
            bench.master.put_joints(request, at_ns)
            bench.show(patch(FAR_MM))
            await bench.until(partial(has_more_than, count), "a frame")
            if ahead_s[-1] is not None:
                return ahead_s[-1]

    monkeypatch.setattr(FrameProcessor, "_report", spy)
    async with bench.running():
        assert await ahead() == pytest.approx(0.0, abs=1e-3)
        bench.master.change_settings({"joint_delay_s": 0.05})
        await bench.beat()
        assert bench.unit.uplink.assignment is not None
        assert bench.unit.uplink.assignment.settings.joint_delay_s == 0.05
        assert await ahead() == pytest.approx(0.05, abs=1e-3)


async def test_no_frame_waits_for_the_look_at_the_joints_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path, with_robot=True)
    looking, release, done = threading.Event(), threading.Event(), threading.Event()

    def look() -> None:
        looking.set()
        assert release.wait(30.0)
        done.set()

    looks = iter([look])
    monkeypatch.setattr(FrameJoints, "watch_delay", lambda *_: next(looks, None))

    async def report(number: int) -> None:
        """Show a frame and wait for its report."""
        at_ns = bench.clock.now
        bench.master.put_joints(JointsRequest(positions=(0.0, 0.1), velocities=(0.0, 0.0), at_ns=at_ns), at_ns)
        bench.show(patch(FAR_MM))
        await bench.until(
            lambda: (row := bench.row()) and row.arrival_age_s is not None and row.health.frame == number, "a report"
        )

    async with bench.running():
        number = 0
        while not looking.is_set():
            # The first may come long after their joints, while kernels are compiled.
            await report(number)
            number += 1
        for later in range(number, number + 3):
            await report(later)
        assert not done.is_set()
        release.set()
        await bench.until(done.is_set, "the look's end")


async def test_joints_that_do_not_fit_are_a_trouble_and_no_end(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path, with_robot=True)
    bench.source.joints = np.zeros(3)
    async with bench.running():
        bench.show(patch(1225))
        row = await bench.until_state("blind")
        assert "2 finite positions" in row.reason
        bench.source.joints = np.zeros(2)
        bench.show(patch(1225))
        await bench.until_state("live")


async def test_the_background_is_learned_kept_and_used_again(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path, learn_background_frames=4)
    async with bench.running():
        for _ in range(3):
            bench.show(patch(1225))
        row = await bench.until(lambda: (row := bench.row()) and row.frame_number == 2 and row, "learning")
        assert row.state == "blind"
        assert row.cause is not None
        assert (row.cause.code, row.cause.numbers) == ("background", {"done": 3.0, "total": 4.0})
        assert "frame 3 of 4" in row.reason
        bench.show(patch(1225))
        await bench.until_state("live")
        assert bench.voxels() == set()
        bench.show(patch(1100))
        await bench.until(bench.voxels, "something before the background")
    # Started again, it knows the background from disk.
    bench.unit = await asyncio.to_thread(bench.make_unit)
    async with bench.running():
        bench.show(patch(1225))
        await bench.until(lambda: (row := bench.row()) and row.frame_number == 5, "the next frame")
        assert bench.voxels() == set()
        command = await bench.ask_and_hear("drop_background")
        bench.show(patch(1225))
        await bench.until(bench.voxels, "no background")
        done = CommandRow(id=command.id, verb="drop_background", outcome="done", code="done")
        await bench.until(lambda: (row := bench.row()) and row.last_command == done, f"{command} done")


async def outcome_of(bench: Bench, verb: Verb) -> CommandRow:
    """Outcome of a command that the next frame answers."""
    command = await bench.ask_and_hear(verb)
    bench.show(patch(1225))
    row = await bench.until(
        lambda: (row := bench.row()) and row.last_command and row.last_command.outcome and row, f"outcome of {verb}"
    )
    assert isinstance(row, UnitRow)
    assert row.last_command is not None
    assert (row.last_command.id, row.last_command.verb) == (command.id, verb)
    return row.last_command


async def test_what_a_unit_cannot_do_it_says(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path, T_world_camera=None)
    async with bench.running():
        await bench.until(lambda: bench.unit.uplink.assignment, "a registration")
        await bench.until_state("uncalibrated")
        refused = await outcome_of(bench, "drop_background")
        assert refused.code == "refused"
        assert "pose" in refused.detail
        assert refused.outcome == refused.detail
        bench.master.set_pose(1, _matrix(ABOVE), "operator", None)
        await bench.beat()
        assert bench.unit.uplink.assignment.T_world_camera is not None
        assert (await outcome_of(bench, "drop_background")).code == "done"


class RefineBench(Bench):
    """The small cell's crate and floor, before a camera whose configured pose is 17 mm and 0.7 degrees off."""

    def __init__(self, folder: Path, **config: Any) -> None:
        off = from_xyz_rpy((0.01, -0.01, 0.01), np.radians((0.4, -0.4, 0.4)))
        rows = tuple(tuple(row) for row in (scenes.OVERHEAD @ off).tolist())
        super().__init__(folder, T_world_camera=PoseConfig(matrix=rows), **config)
        cell = scenes.small_cell(robot=False)
        self.serve(Master(cell, Settings(stale_after_s=60.0)))
        self.source.camera = eye = scenes.camera(424, 240)
        self.frame = scenes.measured(scenes.raycast(scenes.bodies(cell, None), scenes.OVERHEAD, eye), eye)

    async def refine(self) -> CommandRow:
        """Ask for it, show frames, and wait for what became of it."""
        asked = await self.ask_and_hear("refine")
        for _ in range(REFINE_FRAMES - 1):
            self.show(self.frame)
        gathered = Progress(task="refinement", done=REFINE_FRAMES - 1, total=REFINE_FRAMES)
        await self.until(lambda: (row := self.row()) and row.health.progress == gathered, "its progress")
        self.show(self.frame)

        def told() -> CommandRow | None:
            row = self.row()
            last = row.last_command if row else None
            return last if last is not None and last.id == asked.id and last.outcome is not None else None

        found = await self.until(told, "what became of it", beating=True)
        assert isinstance(found, CommandRow)
        return found


async def test_a_pose_is_refined_by_the_cad_on_request(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(RefineBench, tmp_path)
    async with bench.running():
        bench.show(bench.frame)
        before = await bench.until_state("live")
        assert before.T_world_camera is not None
        told = await bench.refine()
        assert (told.outcome, told.code) == ("done", "done")
        assert told.detail.startswith("moved by")
        assert "mm off" in told.detail
        row = bench.row()
        assert row is not None
        assert row.pose_origin == "refined"
        off_mm = 1000.0 * np.linalg.norm(np.subtract(row.T_world_camera, scenes.OVERHEAD)[:3, 3])
        assert off_mm < 6.0
        # Once more there is nothing to be gained.
        bench.show(bench.frame)
        await bench.until_state("live")
        again = await bench.refine()
        assert again.code in ("done", "failed")
        assert again.detail


async def test_a_refined_pose_keeps_what_was_learned(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(RefineBench, tmp_path, learn_background_frames=3)
    async with bench.running():
        for _ in range(3):
            bench.show(bench.frame)
        await bench.until_state("live")
        assert (await bench.refine()).code == "done"
        bench.show(bench.frame)
        row = await bench.until_state("live")
        pipeline = bench.unit._processor.assigned.pipeline
        assert pipeline is not None
        assert pipeline.reference is not None
        assert np.array_equal(pipeline.T_world_camera, np.array(row.T_world_camera))


async def test_who_asked_for_a_background_is_told_when_it_is_given_up(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path)
    async with bench.running():
        bench.show(patch(1225))
        await bench.until_state("live")
        learn = await bench.ask_and_hear("learn_background")
        bench.show(patch(1225))
        row = await bench.until_state("blind")
        assert row.last_command == CommandRow(id=learn.id, verb="learn_background", outcome=None)
        ended: list[tuple[int, OutcomeCode]] = []
        with pytest.MonkeyPatch.context() as monkey:
            monkey.setattr(Slot, "end", lambda slot, command_id, outcome: ended.append((command_id, outcome.code)))
            await bench.ask_and_hear("drop_background")
            bench.show(patch(1225))
            await bench.until(lambda: ended, "both outcomes")
        assert (learn.id, "superseded") in ended


async def test_frames_beyond_the_rate_are_passed_over(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path, fps_max=1.0, trace_path=tmp_path / "trace")
    async with bench.running() as task:
        for _ in range(5):
            bench.show(patch(1225))
        bench.show(None)
        await asyncio.wait_for(task, PATIENCE_S)
    assert [record.frame_number for record in await asyncio.to_thread(read_trace, tmp_path / "trace")] == [0]


async def test_at_the_end_of_a_recording_the_last_frame_is_merged(tmp_path: Path) -> None:
    bench = await asyncio.to_thread(Bench, tmp_path, real_clock=True, trace_path=tmp_path / "trace")
    async with bench.running() as task:
        for _ in range(3):
            bench.show(patch(1225))
        bench.show(None)
        await asyncio.wait_for(task, PATIENCE_S)
    records = await asyncio.to_thread(read_trace, tmp_path / "trace")
    assert [record.frame_number for record in records] == [0, 1, 2]
    last = records[-1]
    assert last.sent
    assert last.merged_at_ns is not None
    assert 0 < last.merged_at_ns - last.captured_at_ns < 10**10
    stages = ["source", "joints", "thread", "robot", "filter", "density", "seen", "health", "check", "report"]
    assert list(last.stages_ns) == stages
    assert all(took_ns >= 0 for took_ns in last.stages_ns.values())
    assert last.sent_at_ns is not None
    assert last.captured_at_ns + sum(last.stages_ns.values()) <= last.sent_at_ns
    assert len(last.keys) // 4 == len(bench.voxels())
    assert last.shape == (20, 40, 10)


async def test_images_are_drawn_on_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The set clock goes on while threads draw, however long they take on a busy machine.
    for module in (core_units, image_requests):
        monkeypatch.setattr(module, "IMAGE_EXPIRES_S", 3600.0)
    bench = await asyncio.to_thread(Bench, tmp_path, T_world_camera=None)
    transport = httpx.ASGITransport(app=lambda *call: bench.app(*call), client=(IP, 40_001))
    headers = {"Authorization": f"Bearer {TOKEN}"}

    async def picture(client: httpx.AsyncClient, path: str) -> httpx.Response:
        asking = asyncio.ensure_future(client.get(f"/units/1/images/{path}"))
        await bench.until(lambda: not bench.unit.uplink.commands.empty(), "asked", beating=True)
        bench.show(patch(1225))
        await bench.until(asking.done, "the answer", beating=True)
        return await asking

    async with bench.running(), httpx.AsyncClient(transport=transport, base_url="http://m", headers=headers) as client:
        await bench.until_state("uncalibrated")
        raw = await picture(client, "depth?raw=1")
        assert raw.status_code == 200, raw.text
        assert (cv2.imdecode(np.frombuffer(raw.content, np.uint8), cv2.IMREAD_UNCHANGED) == patch(1225)).all()
        refused = await picture(client, "expected")
        assert (refused.status_code, "its camera is not known" in refused.text) == (409, True)
        bench.master.set_pose(1, _matrix(ABOVE), "operator", None)
        await bench.beat()
        assert bench.unit.uplink.assignment.T_world_camera is not None
        left = await picture(client, "foreground?raw=1")
        found = cv2.imdecode(np.frombuffer(left.content, np.uint8), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(found).tolist()) == {FAR_MM, 1225}
        coloured = await picture(client, "expected")
        assert cv2.imdecode(np.frombuffer(coloured.content, np.uint8), cv2.IMREAD_UNCHANGED).shape == (48, 64, 3)
        await bench.until_state("live")
        await bench.until(lambda: not bench.master.registry.get(1).pending, "all told", beating=True)


BOARD = Board("grid", 3, 4, 0.08, 0.06, "DICT_4X4_50", 0, from_xyz_rpy((0.4, 1.1, 0.0), (np.pi, 0.0, 0.0)))
BOARD_CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


class LookingSource(FakeSource):
    """Shows the board, when there is one, as from `ABOVE`; depth waits meanwhile."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        picture = BoardPicture(BoardLayout.of(BOARD), BOARD_CAMERA)
        seen = picture.expose(inverse(ABOVE.transform()) @ BOARD.T_world_board)
        self.with_board = picture.develop(seen, np.random.default_rng(0))
        self.info = ImageInfo("infrared", BOARD_CAMERA, (0.0,) * 5, "brown_conrady", np.eye(4))
        self.mounted = False
        self.looks = 0

    @contextlib.asynccontextmanager
    async def open_images(self, stream: ImageStream) -> AsyncIterator[LookingSource]:
        self.looks += 1
        yield self

    async def images(self) -> AsyncGenerator[ImageFrame, None]:
        for number in range(100):
            yield ImageFrame(self.with_board if self.mounted else self.with_board * 0, self.clock.now_ns(), number)


def looking_bench(folder: Path, **config: Any) -> tuple[Bench, LookingSource]:
    bench = Bench(folder, **{"T_world_camera": None, **config})
    bench.serve(Master(replace(make_cell(), board=BOARD), Settings(stale_after_s=60.0)))
    source = LookingSource(bench.clock)
    bench.source = source
    bench.unit = bench.make_unit()
    return bench, source


async def test_without_a_pose_it_looks_for_the_board_until_it_is_mounted(tmp_path: Path) -> None:
    bench, source = await asyncio.to_thread(looking_bench, tmp_path)
    async with bench.running():
        bench.show(patch(1225))
        row = await bench.until(lambda: (row := bench.row()) and "none of" in row.reason and row, "its search")
        assert row.state == "uncalibrated"
        assert row.reason.startswith("searching for the board: none of the board's 12 markers was seen in")
        source.mounted = True
        bench.clock.go_to(bench.clock.now + round(RETRY_MIN_S * S))
        bench.show(patch(1225))
        row = await bench.until(lambda: (row := bench.row()) and row.T_world_camera and row, "its pose")
        assert np.abs(np.array(row.T_world_camera) - ABOVE.transform()).max() < 5e-3
        assert 0.0 < row.pose_quality.uncertainty_mm < 5.0
        assert 0.0 < row.pose_quality.uncertainty_deg < 0.3
        assert 0.0 < row.pose_quality.reprojection_px < 0.2
        looks = source.looks
        bench.show(patch(1225))
        await bench.until_state("live")
        assert bench.voxels()
        assert source.looks == looks


async def test_it_looks_for_the_board_when_asked_even_if_it_has_a_pose(tmp_path: Path) -> None:
    bench, source = await asyncio.to_thread(looking_bench, tmp_path, T_world_camera=BESIDE)
    source.mounted = True
    async with bench.running():
        bench.show(patch(1225))
        await bench.until_state("live")
        assert source.looks == 0
        await bench.ask_and_hear("calibrate")
        bench.show(patch(1225))
        row = await bench.until(lambda: (row := bench.row()) and row.last_command.outcome and row, "done", beating=True)
        assert row.last_command.code == "done"
        assert np.abs(np.array(row.T_world_camera) - ABOVE.transform()).max() < 5e-3
        source.mounted = False
        await bench.ask_and_hear("calibrate")
        bench.show(patch(1225))
        row = await bench.until(
            lambda: (row := bench.row()) and row.last_command.id == 2 and row.last_command.outcome and row,
            "2",
            beating=True,
        )
        assert row.last_command.code == "failed"
        assert "12 markers" in row.last_command.detail
        assert np.abs(np.array(row.T_world_camera) - ABOVE.transform()).max() < 5e-3


async def test_it_does_not_look_by_itself_when_told_not_to(tmp_path: Path) -> None:
    bench, source = await asyncio.to_thread(looking_bench, tmp_path, localise=False)
    source.mounted = True
    async with bench.running():
        for _ in range(2):
            bench.show(patch(1225))
        await bench.until(lambda: (row := bench.row()) and row.frame_number == 1, "frames")
        assert source.looks == 0
