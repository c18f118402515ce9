# SPDX-License-Identifier: Apache-2.0
"""The exchange with the master: register, then report the latest frame, for ever.

A slot of one: a report that was not sent yet is replaced by a newer one, so that a slow network costs frames and
never delay. Whatever goes wrong, it registers again; the master may have been restarted, or may be another.

How far it has come is its phase; each has its own way of trying again, and each change is one line in the journal:

    searching ───► registering ───► fetching ───► localising ───► live
     for a place    at that place    the cell      the camera,     every frame
     every 2 s,     every 50 to      that is not   by the board,   is filtered
     and when       250 ms           on disk       for ever        and reported
     one is heard       ▲            already           ▲              │
     of                 ├────────────────┴─────────────┼──────────────┤ it does not know us any more
        ▲               │                              └──────────────┤ the pose is void
        └───────────────┴─────────────────────────────────────────────┘ nobody answered for 2 s
"""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from edge_unit.joints import JointHistory
from edge_unit.pipeline import SeenBlocks
from edge_unit.sources.frame import CameraInfo
from edge_unit.uplink.cell_cache import CellCache
from edge_unit.uplink.client import MasterClient
from edge_unit.uplink.master_discovery import MasterSearch
from shared.cell import Cell
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import (
    CellError,
    CellwatchError,
    ConfigError,
    MasterRefused,
    MasterUnreachable,
    NewerContract,
    WireError,
)
from shared.lattice import Lattice
from shared.messages import (
    CONTRACT_MINOR,
    CONTRACT_VERSION,
    DONE,
    MAX_COMMANDS,
    MAX_TEXT,
    CellReference,
    Command,
    Ended,
    Health,
    InitializeAnswer,
    InitializeRequest,
    Outcome,
    Phase,
    PoseQuality,
    Progress,
    SeenReport,
    SlotAnswer,
    ToldOrigin,
    TroubleCode,
    UpdateAnswer,
    UpdateRequest,
    Versions,
    matrix_of,
)
from shared.settings import Settings
from shared.timebase import ClockOffset, Exchange
from shared.transforms import Transform, validated
from shared.waiting import within
from shared.wire import decode, pack_seen

logger = logging.getLogger(__name__)

HEARTBEAT_S = 0.2
"""Without a new frame the last report is sent again, often enough for the shortest sensible staleness."""

RETRY_MIN_S = 0.05
RETRY_MAX_S = 0.25
"""A master that returns has its units back within a second, a connection just asked for in vain included."""

JOINTS_TIMEOUT_S = 0.02
"""For joints newer than the last update brought; a frame is not held up longer for them."""

NOT_OURS = frozenset({400, 401, 403, 404, 405, 426})
"""Who answers a registration like this is no master for us: of another contract or token, or none at all."""

CONTRACT_RETRY_S = 5.0
"""Before a newer master that was not understood is asked again, although it told no change."""

START_OVER = frozenset({401, 403, 404, 409})
"""The master does not know this token, unit, session or address any more: register again."""


@dataclass(frozen=True, eq=False)
class Assignment:
    """What the master wants of this unit: all that a frame is processed with."""

    session: int
    versions: Versions
    settings: Settings
    lattice: Lattice
    cell: Cell
    T_world_camera: Transform | None


@dataclass(frozen=True, eq=False)
class Report:
    """One frame's result, and the assignment that it was made with. `seen` is None when nothing is known to be seen.

    `stages_ns` is how long the frame spent in each stage, of one that went through all of them.
    """

    assignment: Assignment
    captured_at_ns: int | None = None
    keys: bytes = b""
    seen: SeenBlocks | None = None
    health: Health = field(default_factory=Health)
    stages_ns: dict[str, int] = field(default_factory=dict)


class Trouble(NamedTuple):
    """Why a unit reports no voxels: a code, a sentence, and how far it is with what is to be waited for."""

    code: TroubleCode
    sentence: str
    progress: Progress | None = None

    def facts(self) -> dict[str, Any]:
        """The fields of `Health` that tell it; a sentence that is too long is cut."""
        return {"trouble": self.sentence[:MAX_TEXT], "trouble_code": self.code, "progress": self.progress}


@dataclass(frozen=True)
class _Unclear:
    """A session of which this unit does not understand all that it would have to obey."""

    session: int
    versions: Versions
    trouble: Trouble
    since_ns: int


class Delivery(NamedTuple):
    """When a report was sent, when the master had all of it, and when it had merged it: by the unit's clock, in ns."""

    sent_at_ns: int
    received_at_ns: int
    merged_at_ns: int


class Uplink:
    """Registers and reports in the background; `run` never returns."""

    def __init__(
        self,
        client: MasterClient,
        cells: CellCache,
        software: str,
        boot_id: str,
        on_sent: Callable[[Report, Delivery | None], None],
        search: MasterSearch | None = None,
    ) -> None:
        """`on_sent` is told of each report how it reached the master; None: it never did.

        `search` tells where the master is; without, it is where the client was aimed at, for ever.
        """
        self._client = client
        self._search = search
        self._cells = cells
        self._software = software
        self._boot_id = boot_id
        self._on_sent = on_sent
        self._camera: CameraInfo | None = None
        self._known_pose: tuple[Transform, ToldOrigin] | None = None
        self._fresh: Report | None = None
        self._last: Report | None = None
        self._wake = asyncio.Event()
        self._idle = asyncio.Event()
        self._idle.set()
        self._exchange: Exchange | None = None
        self._acknowledged: tuple[Versions, bytes] | None = None
        self._complaint = ""
        self._found_by = ""
        self._id = 0
        self._sequence = 0
        self._done: list[Ended] = []
        self._open_commands: dict[int, Command] = {}
        self._master_minor = 0
        self._unclear: _Unclear | None = None
        self._refused = ""
        self.assignment: Assignment | None = None
        self.assigned = asyncio.Event()
        self.phase: Phase | None = None
        self.commands: asyncio.Queue[Command] = asyncio.Queue(MAX_COMMANDS)
        self.joints = JointHistory()
        self.clock = ClockOffset()
        self.trouble: Trouble | None = None
        self.warning: str | None = None

    # ------------------------------------------------------------------ what the unit calls

    def set_camera(self, camera: CameraInfo, known_pose: tuple[Transform, ToldOrigin] | None) -> None:
        """This is the camera to register with; another one than before means registering again.

        `known_pose` (`T_world_camera` and where it is from) is told to the master, which may know better.
        """
        if self._camera is not None and (self._camera.serial, self._camera.intrinsics) != (
            camera.serial,
            camera.intrinsics,
        ):
            self._start_over()
        self._camera = camera
        self._known_pose = known_pose
        self._wake.set()

    def offer(self, report: Report) -> None:
        """Report this next; what was offered before and not sent yet is dropped."""
        if self._fresh is not None:
            self._on_sent(self._fresh, None)
        self._fresh = report
        self._idle.clear()
        self._wake.set()

    def finish(self, command: Command, outcome: Outcome = DONE) -> None:
        """A command came to an end: carried out, or why not; the master is told with the next update."""
        if command.id in self._open_commands:
            self._done.append(Ended.of(command.id, outcome))

    async def send_picture(self, command: Command, png: bytes) -> None:
        """Send the picture that a command asks for. Raises as `MasterClient.update`."""
        assert command.image is not None
        await self._client.put_image(self._id, command.image, command.id, png)

    async def tell_pose(self, T_world_camera: Transform, origin: str, quality: PoseQuality) -> None:
        """This unit's camera was found to be there; the next frame is processed with it.

        Raises:
            UplinkError: the master did not hear of it, or refused it.
            WireError: its answer is none of ours.
        """
        assignment = self.assignment
        version = await self._client.put_pose(self._id, T_world_camera, origin, quality)
        if assignment is not None and self.assignment is not None and self.assignment.session == assignment.session:
            versions = self.assignment.versions.model_copy(update={"pose": version})
            self._assign(replace(self.assignment, versions=versions, T_world_camera=T_world_camera))

    @property
    def standing(self) -> str:
        """How it stands with the master, in words for a person."""
        if self._search is not None and not self._client.url:
            return f"no master: {self._search.outcome}"
        if self._complaint:
            return f"no master: {self._complaint}"
        if self._unclear is not None:
            return self._unclear.trouble.sentence
        if self.assignment is None:
            return f"not registered yet at {self._client.url}"
        return f"unit {self._id} at {self._client.url}"

    async def drained(self, timeout_s: float) -> None:
        """Wait until nothing is left to be sent, but no longer than `timeout_s`."""
        if not await within(timeout_s, self._idle.wait()):
            logger.warning("the last frame did not reach the master")

    async def refresh_joints(self, at_master_ns: int) -> None:
        """Ask for joints up to `at_master_ns` if none so new are known; what cannot be had in time is done without."""
        if self.joints.newest_ns >= at_master_ns or self.assignment is None:
            return
        try:
            answer = await self._client.robot(self.joints.newest_ns, JOINTS_TIMEOUT_S)
        except CellwatchError as error:
            logger.debug("no fresh joints: %s", error)
        else:
            self.joints.add(answer.joints)

    # ------------------------------------------------------------------ the exchange

    async def run(self) -> None:
        """Register and report until cancelled."""
        retry_s = RETRY_MIN_S
        while True:
            try:
                await self._turn_to_master()
                assignment = self.assignment
                if self._unclear is not None:
                    await self._tell_unclear(self._unclear)
                elif assignment is None:
                    await self._register()
                else:
                    await self._report(assignment)
                retry_s, self._complaint = RETRY_MIN_S, ""
                if self._search is not None:
                    self._search.answered(self._client.url)
                if self.phase == "searching" and self.assignment is not None:
                    self._enter(_phase_of(self.assignment), f"{self._client.url} answers again")
            except MasterRefused as error:
                registered = self.assignment is not None or self._unclear is not None
                if error.status in START_OVER and registered:
                    self._start_over()
                self._miss(error, error.status in NOT_OURS and self.assignment is None)
                retry_s = await self._wait(retry_s, error)
            except CellwatchError as error:
                foreign = isinstance(error, WireError) and self.assignment is None and self._unclear is None
                if isinstance(error, (WireError, CellError)) and self._master_minor > CONTRACT_MINOR:
                    # What registering anew cannot clear up is told as trouble then.
                    self._start_over()
                self._miss(error, foreign or isinstance(error, MasterUnreachable))
                retry_s = await self._wait(retry_s, error)

    async def _turn_to_master(self) -> None:
        """To another one, if another was found; while none is known at all, wait."""
        if self._search is None:
            return
        if not self._client.url:
            self._enter("searching", self._search.outcome)
        place = await self._search.place()
        if place.url != self._client.url:
            self._client.aim(place.url)
            self._found_by = place.found_by
            self._start_over()

    def _miss(self, error: CellwatchError, lost: bool) -> None:
        """What went wrong may mean that the master is elsewhere."""
        if self._search is not None and lost:
            self._search.unanswered(monotonic_ns())
            if self._search.lost:
                self._enter("searching", str(error))

    def _enter(self, phase: Phase, reason: str) -> None:
        """Be in this phase from now on, and say so if it is another one."""
        if phase != self.phase:
            before = f"{self.phase} → " if self.phase else ""
            logger.info("%s%s: %s", before, phase, reason)
            self.phase = phase

    async def _register(self) -> None:
        if self._search is None or not self._search.lost:
            self._enter("registering", f"at {self._client.url}{f', {self._found_by}' if self._found_by else ''}")
        while self._camera is None:
            self._wake.clear()
            await self._wake.wait()
        camera = self._camera
        await self._client.authorize()
        told, origin = self._known_pose or (None, "configured")
        sent_at_ns = monotonic_ns()
        request = InitializeRequest(
            contract=CONTRACT_VERSION,
            contract_minor=CONTRACT_MINOR,
            serial=camera.serial,
            model=camera.model,
            intrinsics=camera.intrinsics,
            software=self._software,
            boot_id=self._boot_id,
            T_world_camera=None if told is None else matrix_of(told),
            pose_origin=origin,
            sent_at_ns=sent_at_ns,
        )
        try:
            answer = await self._client.initialize(request)
        except NewerContract as error:
            slot = decode(SlotAnswer, error.answer)
            self._begin_session(slot, sent_at_ns)
            self._refuse(slot, error)
            return
        self._begin_session(answer, sent_at_ns)
        self.joints.add(answer.joints)
        self._enter("fetching", f"unit {answer.id}, cell {answer.cell.name}")
        try:
            cell = await self._get_cell(answer.cell)
        except (WireError, CellError) as error:
            if answer.contract_minor <= CONTRACT_MINOR:
                raise
            self._refuse(answer, error)
            return
        pose = None if answer.T_world_camera is None else validated(answer.T_world_camera, "T_world_camera")
        assignment = Assignment(answer.session, answer.versions, answer.settings, answer.lattice.lattice(), cell, pose)
        self._assign(assignment, f"registered at {self._client.url} as unit {answer.id}, ")

    def _begin_session(self, slot: InitializeAnswer | SlotAnswer, sent_at_ns: int) -> None:
        """Registered at `sent_at_ns`: what was before is void."""
        self.clock = ClockOffset()
        self.joints.clear()
        self._exchange = Exchange(sent_at_ns, slot.received_at_ns, slot.answered_at_ns, monotonic_ns())
        self.clock.add(self._exchange)
        self._master_minor = slot.contract_minor
        self._id = slot.id
        self._sequence = 0
        self._acknowledged = None
        self._done.clear()
        self._open_commands.clear()
        # Those of the session before; the master sends again what it still wants.
        while not self.commands.empty():
            self.commands.get_nowait()

    def _refuse(self, slot: InitializeAnswer | SlotAnswer, error: CellwatchError) -> None:
        """Do not follow a newer master that is not understood: what is unknown may have to be left unfiltered."""
        theirs, ours = f"{CONTRACT_VERSION}.{slot.contract_minor}", f"{CONTRACT_VERSION}.{CONTRACT_MINOR}"
        trouble = Trouble("contract", f"update this unit: it speaks contract {ours}, its master {theirs}: {error}")
        self._unclear = _Unclear(slot.session, slot.versions, trouble, monotonic_ns())
        level = logging.DEBUG if trouble.sentence == self._refused else logging.WARNING
        logger.log(level, "%s", trouble.sentence)
        self._refused = trouble.sentence

    async def _tell_unclear(self, unclear: _Unclear) -> None:
        """Tell why nothing is reported; register again when the master says something else, or now and then."""
        self._drop_fresh()
        await self._woken()
        self._drop_fresh()
        sent_at_ns = monotonic_ns()
        if sent_at_ns - unclear.since_ns > CONTRACT_RETRY_S * NS_PER_S:
            self._start_over()
            return
        self._sequence += 1
        answer = await self._client.update(
            UpdateRequest(
                id=self._id,
                session=unclear.session,
                sequence=self._sequence,
                sent_at_ns=sent_at_ns,
                exchange=self._exchange,
                # Not that it works with these, but that it knows of them: so it is not told of them again.
                versions=unclear.versions,
                health=Health().model_copy(update=unclear.trouble.facts()),
                phase="fetching",
            )
        )
        self._exchange = Exchange(sent_at_ns, answer.received_at_ns, answer.answered_at_ns, monotonic_ns())
        self.clock.add(self._exchange)
        if answer.versions != unclear.versions:
            self._start_over()

    def _drop_fresh(self) -> None:
        """What was offered will not be sent."""
        if self._fresh is not None:
            self._on_sent(self._fresh, None)
            self._fresh = None
        self._idle.set()

    async def _woken(self) -> None:
        """Wait until something is to be sent, but no longer than until the next heartbeat."""
        self._wake.clear()
        # No wait_for here: until Python 3.12 it swallows a cancellation that comes together with the event.
        heartbeat = asyncio.get_running_loop().call_later(HEARTBEAT_S, self._wake.set)
        try:
            await self._wake.wait()
        finally:
            heartbeat.cancel()

    async def _get_cell(self, reference: CellReference) -> Cell:
        cell = await self._cells.get(reference, self._client)
        if self._search is not None:
            await self._search.keep(self._client.url, reference.name)
        return cell

    async def _report(self, assignment: Assignment) -> None:
        """Send the latest report, or, when none comes, the one before again."""
        if self._fresh is None:
            await self._woken()
        fresh, self._fresh = self._fresh, None
        report = fresh or self._last or Report(assignment)
        if report.assignment.session != assignment.session:
            # Made for a session that is over, in which the same versions may have meant something else.
            if fresh is not None:
                self._on_sent(fresh, None)
            report = Report(assignment)
        self._last = report
        try:
            answer, delivery = await self._exchange_update(assignment, report)
        except CellwatchError:
            self._put_back(fresh)
            raise
        finally:
            if self._fresh is None:
                self._idle.set()
        if fresh is not None:
            self._on_sent(fresh, delivery)
        await self._follow(assignment, answer)

    def _put_back(self, report: Report | None) -> None:
        """What could not be sent is tried again, unless a newer one came meanwhile."""
        if self._fresh is None:
            self._fresh = report
        elif report is not None:
            self._on_sent(report, None)

    async def _exchange_update(self, assignment: Assignment, report: Report) -> tuple[UpdateAnswer, Delivery]:
        self._sequence += 1
        versions = report.assignment.versions
        seen_bits = report.seen.packed() if report.seen is not None else b""
        seen = None
        if report.seen is not None and self._acknowledged != (versions, seen_bits):
            seen = seen_report(report.seen)
            # Until the master has answered nobody knows which of the two it holds.
            self._acknowledged = None
        done = tuple(self._done[:MAX_COMMANDS])
        health = report.health
        if self.trouble is not None:
            health = health.model_copy(update=self.trouble.facts())
        if self.warning is not None:
            health = health.model_copy(update={"warning": self.warning})
        sent_at_ns = monotonic_ns()
        answer = await self._client.update(
            UpdateRequest(
                id=self._id,
                session=assignment.session,
                sequence=self._sequence,
                captured_at_ns=report.captured_at_ns,
                sent_at_ns=sent_at_ns,
                exchange=self._exchange,
                versions=versions,
                keys=report.keys,
                seen=seen,
                health=health,
                joints_until_ns=self.joints.newest_ns,
                done=done,
                phase=_phase_of(assignment),
            )
        )
        self._exchange = Exchange(sent_at_ns, answer.received_at_ns, answer.answered_at_ns, monotonic_ns())
        self.clock.add(self._exchange)
        self.joints.add(answer.joints)
        if report.seen is not None:
            self._acknowledged = versions, seen_bits
        self._forget_commands(done)
        offset_ns = self.clock.offset_ns
        return answer, Delivery(sent_at_ns, answer.received_at_ns - offset_ns, answer.answered_at_ns - offset_ns)

    async def _follow(self, assignment: Assignment, answer: UpdateAnswer) -> None:
        """Do what the master's answer asks for."""
        self._accept_commands(answer.commands)
        if answer.versions == assignment.versions:
            return
        changed = replace(assignment, versions=answer.versions)
        if answer.settings is not None:
            changed = replace(changed, settings=answer.settings)
        if answer.lattice is not None:
            changed = replace(changed, lattice=answer.lattice.lattice())
        if answer.cell is not None:
            changed = replace(changed, cell=await self._get_cell(answer.cell))
        if answer.versions.pose != assignment.versions.pose:
            pose = answer.T_world_camera
            changed = replace(changed, T_world_camera=None if pose is None else validated(pose, "T_world_camera"))
        if self.assignment is assignment:
            # Otherwise the camera was changed meanwhile, and this session is over.
            self._assign(changed)

    def _accept_commands(self, commands: Iterable[Command]) -> None:
        for command in commands:
            if command.id not in self._open_commands and not self.commands.full():
                self._open_commands[command.id] = command
                self.commands.put_nowait(command)

    def _forget_commands(self, done: Iterable[Ended]) -> None:
        for ended in done:
            self._done.remove(ended)
            self._open_commands.pop(ended.id, None)

    def _assign(self, assignment: Assignment, how: str = "") -> None:
        self.assignment = assignment
        self.assigned.set()
        pose = "nobody knows its camera's pose" if assignment.T_world_camera is None else "its camera's pose is known"
        self._enter(_phase_of(assignment), f"{how}{pose}")

    def _start_over(self) -> None:
        self.assignment = None
        self._unclear = None
        self.assigned.clear()

    async def _wait(self, retry_s: float, error: CellwatchError) -> float:
        """Wait before the next attempt; returns how long to wait after that."""
        # Once each: a master that is gone, and then one with another certificate.
        new = retry_s == RETRY_MIN_S or str(error) != self._complaint
        self._complaint = str(error)
        level = logging.WARNING if new or isinstance(error, ConfigError) else logging.DEBUG
        logger.log(level, "%s", error)
        await asyncio.sleep(retry_s * random.uniform(0.8, 1.2))
        return min(2.0 * retry_s, RETRY_MAX_S)


def _phase_of(assignment: Assignment) -> Phase:
    return "localising" if assignment.T_world_camera is None else "live"


def seen_report(seen: SeenBlocks) -> SeenReport:
    """The blocks as a report, in larger ones where it would be too long."""
    while True:
        nx, ny, nz = seen.lattice.shape
        report = pack_seen(seen.seen.reshape(nx, ny, nz), seen.lattice.voxel_size_m)
        if report is not None:
            return report
        seen = seen.coarser()
