# SPDX-License-Identifier: Apache-2.0
"""The exchange with a fake master, with a clock that the tests set."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, cast

import msgpack
import numpy as np
import pytest

from edge_unit.pipeline import SeenBlocks
from edge_unit.sources.frame import CameraInfo
from edge_unit.uplink import uplink as module
from edge_unit.uplink.assignment import Delivery, Report, Trouble, seen_report
from edge_unit.uplink.cell_cache import CellCache
from edge_unit.uplink.client import TIMEOUT, MasterClient
from edge_unit.uplink.outbox import HEARTBEAT_S
from edge_unit.uplink.uplink import Uplink
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.errors import MasterRefused, MasterUnreachable, NewerContract, WireError
from shared.lattice import Lattice
from shared.messages import (
    CONTRACT_MINOR,
    MAX_SEEN_BYTES,
    CellReference,
    Command,
    InitializeAnswer,
    InitializeRequest,
    JointSample,
    LatticeDescription,
    Outcome,
    RobotAnswer,
    UpdateAnswer,
    UpdateRequest,
    Versions,
    matrix_of,
)
from shared.settings import Settings
from shared.transforms import from_xyz_rpy
from shared.wire import unpack_seen
from tests.set_clock import MS, S, SetClock

CAMERA = CameraInfo("A", "model", Intrinsics(8, 6, 10.0, 10.0, 4.0, 3.0))
POSE = from_xyz_rpy((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
CELL = Cell("cell", np.zeros(3), np.ones(3))
LATTICE = CELL.lattice(0.05)
CLOCK_AHEAD_NS = 5 * 10**12

TURNS = 50
"""Number of event loop turns: more than the uplink needs from one wait to the next, as it waits only for the clock."""

CALLS = 100
"""Number of clock calls: more than any test needs."""


@dataclass
class FakeMaster:
    """A master that uses `answers` in turn: an error, or the fields of an answer. Then it answers with defaults.

    Each request and each answer takes `trip_ns`. The master's clock is ahead of the unit's.
    """

    clock: SetClock
    versions: Versions = field(default_factory=lambda: Versions(settings=1, lattice=1, cell=1, pose=1))
    knows_pose: bool = True
    answers: list[Exception | dict[str, Any]] = field(default_factory=list)
    registrations: list[InitializeRequest] = field(default_factory=list)
    refused_at_ns: list[int] = field(default_factory=list)
    updates: list[UpdateRequest] = field(default_factory=list)
    poses: list[tuple[int, str]] = field(default_factory=list)
    joints: tuple[JointSample, ...] = ()
    refuse: Exception | None = None
    gate: asyncio.Event | None = None
    trip_ns: int = MS
    url: str = "http://fake"

    def now_ns(self) -> int:
        """Return the time at which a request reaches the master, by its clock."""
        self.clock.now += self.trip_ns
        return self.clock.now + CLOCK_AHEAD_NS

    async def authorize(self) -> None:
        """Accept each token."""

    async def initialize(self, request: InitializeRequest) -> InitializeAnswer:
        if self.refuse is not None:
            self.refused_at_ns.append(self.clock.now)
            raise self.refuse
        self.registrations.append(request)
        now_ns = self.now_ns()
        self.clock.now += self.trip_ns
        return InitializeAnswer(
            id=7,
            session=100 + len(self.registrations),
            versions=self.versions,
            settings=Settings(),
            lattice=LatticeDescription.of(LATTICE),
            cell=CellReference(name="cell", sha256=CELL.version),
            T_world_camera=matrix_of(POSE) if self.knows_pose else None,
            received_at_ns=now_ns,
            answered_at_ns=now_ns,
        )

    async def update(self, update: UpdateRequest) -> UpdateAnswer:
        self.updates.append(update)
        if self.gate is not None:
            await self.gate.wait()
        answer = self.answers.pop(0) if self.answers else {}
        if isinstance(answer, Exception):
            raise answer
        now_ns = self.now_ns()
        self.clock.now += self.trip_ns
        fields = {"versions": self.versions, "received_at_ns": now_ns, "answered_at_ns": now_ns, **answer}
        return UpdateAnswer(**fields)

    async def robot(self, since_ns: int, timeout_s: float) -> RobotAnswer:
        if self.refuse is not None:
            raise self.refuse
        samples = tuple(sample for sample in self.joints if sample.at_ns > since_ns)
        return RobotAnswer(state="fresh", joint_names=("a",), now_ns=self.now_ns(), joints=samples)

    async def put_pose(self, unit_id: int, T_world_camera: Any, origin: str) -> int:
        self.poses.append((unit_id, origin))
        return 9


class OneCell:
    async def get(self, reference: CellReference, client: Any) -> Cell:
        return CELL


class Bench:
    def __init__(self, **fields: Any) -> None:
        self.clock = SetClock()
        self.master = FakeMaster(self.clock, **fields)
        self.sent: list[tuple[Report, Delivery | None]] = []
        self.uplink = Uplink(
            cast(MasterClient, self.master),
            cast(CellCache, OneCell()),
            "software",
            "boot",
            lambda report, delivery: self.sent.append((report, delivery)),
            clock=self.clock,
        )

    def report(self, number: int = 0, seen: SeenBlocks | None = None) -> Report:
        assert self.uplink.assignment is not None
        return Report(self.uplink.assignment, self.clock.now, bytes((number, 0, 0, 0)), seen)

    def keys(self) -> list[int]:
        return [update.keys[0] if update.keys else -1 for update in self.master.updates]

    async def until(self, condition: Callable[[], Any], calls: int = CALLS) -> None:
        """Run the uplink until it waits, then step the clock to its next call, until `condition` is true."""
        for _ in range(calls):
            for _ in range(TURNS):
                if condition():
                    return
                await asyncio.sleep(0)
            assert self.clock.due_ns() is not None, "the uplink waits, but not for the clock"
            self.clock.step()
        pytest.fail(f"not within {calls} calls of the clock")


@contextlib.asynccontextmanager
async def running(**fields: Any) -> AsyncIterator[Bench]:
    """Yield a bench with a registered uplink, or with one that is refused."""
    bench = Bench(**fields)
    task = asyncio.create_task(bench.uplink.run())
    bench.uplink.set_camera(CAMERA, None)
    try:
        if bench.master.refuse is None:
            await bench.until(bench.uplink.assigned.is_set)
        yield bench
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def test_it_registers_and_reports() -> None:
    async with running() as bench:
        report = bench.report(1)
        before_ns = bench.clock.now
        bench.uplink.offer(report)
        await bench.until(lambda: bench.sent)
        update = next(update for update in bench.master.updates if update.keys)
        assert (update.id, update.session) == (7, 101)
        assert update.captured_at_ns == report.captured_at_ns
        assert update.versions == bench.master.versions
        assert update.exchange is not None
        assert update.exchange.offset_ns == CLOCK_AHEAD_NS
        assert update.exchange.returned_ns - update.exchange.sent_ns == 2 * MS
        sent, delivery = bench.sent[0]
        assert sent is report
        assert delivery is not None
        # The times are of the unit's clock, although the master's clock is far ahead.
        assert delivery == Delivery(before_ns, before_ns + MS, before_ns + MS)
    assert bench.master.registrations[0].serial == "A"


async def test_only_the_latest_report_is_sent() -> None:
    gate = asyncio.Event()
    async with running(gate=gate) as bench:
        bench.uplink.offer(bench.report(1))
        await bench.until(lambda: bench.keys()[-1:] == [1])
        for number in (2, 3, 4):
            bench.uplink.offer(bench.report(number))
        gate.set()
        await bench.until(lambda: len(bench.sent) == 4)
        assert bench.keys()[-2:] == [1, 4]
        assert [merged is not None for _, merged in bench.sent] == [False, False, True, True]


async def test_sequences_rise_and_the_last_report_is_repeated_while_nothing_new_comes() -> None:
    async with running() as bench:
        bench.uplink.offer(bench.report(1))
        await bench.until(lambda: bench.keys().count(1) >= 3)
        sequences = [update.sequence for update in bench.master.updates]
        assert sequences == sorted(set(sequences))
        repeated = [update for update in bench.master.updates if update.keys]
        assert len({update.captured_at_ns for update in repeated}) == 1
        # Each is sent a heartbeat after the answer to the one before.
        assert {b.sent_at_ns - a.sent_at_ns for a, b in pairwise(repeated)} == {round(HEARTBEAT_S * S) + 2 * MS}
        assert len(bench.sent) == 1


@pytest.mark.parametrize("status", [401, 403, 404, 409])
async def test_it_registers_again_at_a_master_that_does_not_know_it(status: int) -> None:
    async with running() as bench:
        bench.master.answers = [MasterRefused("gone", status)]
        bench.uplink.offer(bench.report(1))
        await bench.until(lambda: len(bench.master.registrations) == 2 and bench.uplink.assignment is not None)
        before = len(bench.master.updates)
        await bench.until(lambda: len(bench.master.updates) > before)
        # A report of the earlier session is not sent in the new one.
        assert {(update.session, update.keys) for update in bench.master.updates[before:]} == {(102, b"")}
        bench.uplink.offer(bench.report(2))
        await bench.until(lambda: bench.keys()[-1] == 2)


@pytest.mark.parametrize("error", [MasterUnreachable("nobody"), MasterRefused("busy", 503), WireError("nonsense")])
async def test_other_errors_are_retried_in_the_same_session(error: Exception) -> None:
    async with running() as bench:
        bench.master.answers = [error, error]
        bench.uplink.offer(bench.report(1))
        await bench.until(lambda: bench.sent)
        assert bench.keys()[-3:] == [1, 1, 1]
        assert [merged is not None for _, merged in bench.sent] == [True]
        assert len(bench.master.registrations) == 1


async def test_it_retries_at_an_unreachable_master(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.random, "uniform", lambda low, high: (low + high) / 2.0)
    async with running(refuse=MasterUnreachable("nobody")) as bench:
        await bench.until(lambda: len(bench.master.refused_at_ns) == 6)
        assert bench.uplink.assignment is None
        # The pauses grow up to a bound, which is short enough for a master that returns.
        waits_ms = [(after - before) / MS for before, after in pairwise(bench.master.refused_at_ns)]
        assert waits_ms == [50.0, 100.0, 200.0, 250.0, 250.0]
        bench.master.refuse = None
        last_ns = bench.clock.now
        await bench.until(bench.uplink.assigned.is_set)
        assert bench.clock.now - last_ns <= round(module.RETRY_MAX_S * S) + 2 * MS


@pytest.mark.parametrize("knows_pose", [False, True])
async def test_a_known_pose_is_reported_and_the_masters_answer_is_used(knows_pose: bool) -> None:
    bench = Bench(knows_pose=knows_pose)
    reported = from_xyz_rpy((0.0, 0.0, 0.5), (0.0, 0.0, 0.0))
    task = asyncio.create_task(bench.uplink.run())
    bench.uplink.set_camera(CAMERA, (reported, "source"))
    await bench.until(bench.uplink.assigned.is_set)
    task.cancel()
    assert bench.master.registrations[0].T_world_camera == matrix_of(reported)
    assert bench.master.registrations[0].pose_origin == "source"
    assert bench.uplink.assignment is not None
    pose = bench.uplink.assignment.T_world_camera
    assert np.array_equal(pose, POSE) if knows_pose else pose is None


async def test_a_change_at_the_master_is_a_new_assignment() -> None:
    async with running() as bench:
        first = bench.uplink.assignment
        assert first is not None
        moved = from_xyz_rpy((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
        bench.master.versions = Versions(settings=2, lattice=2, cell=1, pose=2)
        changes = {
            "settings": Settings(voxel_size_m=0.1),
            "lattice": LatticeDescription.of(CELL.lattice(0.1)),
            "T_world_camera": matrix_of(moved),
        }
        bench.master.answers = [changes]
        await bench.until(lambda: bench.uplink.assignment is not first)
        second = bench.uplink.assignment
        assert second is not None
        assert second.versions == bench.master.versions
        assert second.lattice.voxel_size_m == second.settings.voxel_size_m == 0.1
        assert second.T_world_camera is not None
        assert np.array_equal(second.T_world_camera, moved)
        assert second.cell is first.cell
        assert second.session == first.session
        # The master removes the pose.
        bench.master.versions = bench.master.versions.model_copy(update={"pose": 3})
        await bench.until(lambda: bench.uplink.assignment is not second)
        assert bench.uplink.assignment is not None
        assert bench.uplink.assignment.T_world_camera is None


async def test_another_camera_ends_the_session_even_while_an_answer_is_under_way() -> None:
    gate = asyncio.Event()
    async with running(gate=gate) as bench:
        await bench.until(lambda: bench.master.updates)
        bench.uplink.set_camera(CameraInfo("B", "model", CAMERA.intrinsics), None)
        bench.master.versions = Versions(settings=2, lattice=1, cell=1, pose=1)
        gate.set()
        await bench.until(lambda: len(bench.master.registrations) == 2 and bench.uplink.assignment is not None)
        assert bench.master.registrations[1].serial == "B"
        assert bench.uplink.assignment is not None
        assert bench.uplink.assignment.session == 102


async def test_commands_are_executed_once_and_reported_until_the_master_confirms() -> None:
    async with running() as bench:
        command = Command(id=5, verb="learn_background")
        bench.master.answers = [{"commands": (command,)}] * 3
        await bench.until(lambda: not bench.master.answers)
        assert bench.uplink.commands.get_nowait() == command
        assert bench.uplink.commands.empty()
        bench.master.answers = [MasterUnreachable("nobody")]
        bench.uplink.finish(command, Outcome("failed", "no board in view"))
        before = len(bench.master.updates)
        ended = ((5, "no board in view", "failed"),)
        await bench.until(
            lambda: len([update for update in bench.master.updates[before:] if update.done == ended]) >= 2
        )
        await bench.until(lambda: bench.master.updates[-1].done == ())


async def test_missing_joints_are_requested() -> None:
    async with running() as bench:
        now_ns = bench.clock.now
        bench.master.joints = (JointSample(now_ns, (0.5,), None),)
        await bench.uplink.refresh_joints(now_ns)
        assert bench.uplink.joints.newest_ns == now_ns
        bench.master.refuse = MasterUnreachable("nobody")
        await bench.uplink.refresh_joints(now_ns + 1)
        assert bench.uplink.joints.newest_ns == now_ns


async def test_seen_blocks_are_sent_after_a_change_and_until_confirmed() -> None:
    lattice = Lattice((0.0, 0.0, 0.0), 0.1, (4, 4, 4))
    one = SeenBlocks(np.ones(64, np.uint8), lattice)
    other = SeenBlocks(np.zeros(64, np.uint8), lattice)
    async with running() as bench:
        for number, (seen, is_sent) in enumerate(((one, True), (one, False), (other, True), (other, False)), 1):
            bench.uplink.offer(bench.report(number, seen))
            await bench.until(lambda number=number: len(bench.sent) == number)
            first = next(update for update in bench.master.updates if update.keys[:1] == bytes((number,)))
            assert (first.seen is not None) == is_sent
        bench.master.answers = [MasterUnreachable("nobody")]
        bench.uplink.offer(bench.report(5, one))
        await bench.until(lambda: len([u for u in bench.master.updates if u.keys[:1] == b"\5" and u.seen]) == 2)


async def test_each_report_has_the_cameras_trouble() -> None:
    async with running() as bench:
        bench.uplink.camera_state.trouble = Trouble("camera", "camera: unplugged")
        await bench.until(
            lambda: bench.master.updates and bench.master.updates[-1].health.trouble == "camera: unplugged"
        )
        bench.uplink.camera_state.trouble = None
        await bench.until(lambda: bench.master.updates[-1].health.trouble is None)


def test_a_seen_report_that_is_too_long_has_larger_blocks() -> None:
    shape = (50, 50, 40)
    noise = np.random.default_rng(1).random(shape) < 0.95
    report = seen_report(SeenBlocks(noise.astype(np.uint8).reshape(-1), Lattice((0.0, 0.0, 0.0), 0.1, shape)))
    assert len(report.bits) <= MAX_SEEN_BYTES
    assert report.shape == (25, 25, 20)
    assert report.block_size_m == pytest.approx(0.2)
    coarse = unpack_seen(report)
    for index in np.argwhere(coarse)[:100]:
        low = 2 * index
        assert noise[tuple(slice(a, a + 2) for a in low)].all()


def test_a_reconnect_takes_less_than_a_second_in_the_worst_case() -> None:
    assert TIMEOUT.connect is not None
    # A connection attempt that started just before, the longest pause after it, and 0.2 s to register and report.
    assert TIMEOUT.connect + 1.2 * module.RETRY_MAX_S + 0.2 <= 1.0


class NewerMaster(FakeMaster):
    """A master of the next minor version, whose answer to a registration has a field unknown to this unit."""

    async def initialize(self, request: InitializeRequest) -> InitializeAnswer:
        answer = await super().initialize(request)
        newer = answer.model_dump(mode="json") | {"contract_minor": CONTRACT_MINOR + 1}
        raise NewerContract("settings.fog: extra inputs are not permitted", msgpack.packb(newer))


async def test_it_registers_again_with_growing_pauses_at_a_master_that_it_does_not_understand() -> None:
    bench = Bench()
    bench.master = bench.uplink._client = NewerMaster(bench.clock)
    registered_ns: list[int] = []

    def registered(count: int) -> bool:
        while len(registered_ns) < len(bench.master.registrations):
            registered_ns.append(bench.clock.now)
        return len(registered_ns) >= count

    task = asyncio.create_task(bench.uplink.run())
    bench.uplink.set_camera(CAMERA, None)
    try:
        await bench.until(lambda: registered(1))
        # The trouble is sent at once, not with the first heartbeat.
        before_ns = bench.clock.now
        await bench.until(lambda: bench.master.updates)
        assert bench.clock.now - before_ns < HEARTBEAT_S * S / 2
        for count in (2, 3, 4):
            await bench.until(lambda count=count: registered(count), calls=10_000)
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    pauses_s = [(after - before) / S for before, after in pairwise(registered_ns)]
    assert pauses_s == pytest.approx([5.0, 10.0, 20.0], abs=2 * HEARTBEAT_S)
    assert {update.health.trouble_code for update in bench.master.updates} == {"contract"}
