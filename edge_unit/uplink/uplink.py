# SPDX-License-Identifier: Apache-2.0
"""The exchange with the master: register once, then report the latest frame until cancelled.

The outbox holds one report. A newer report replaces one that is not sent yet, so a slow network drops frames and adds
no delay. After an error that ends the session the unit registers again, at a restarted master or at another one.

The unit's progress is its phase. Each phase has its own retries, and each change of phase is one log line:

    searching ───► registering ───► fetching ───► localising ───► live
     for a master   at its address   the cell      the camera      each frame
     every 2 s,     every 50 to      that is not   by the board,   is filtered
     and at each    250 ms           on disk       without limit   and reported
     announcement       ▲                ▲             ▲              │
                        ├────────────────┴─────────────┼──────────────┤ the master does not know the unit
        ▲               │                              └──────────────┤ the pose is void
        └───────────────┴─────────────────────────────────────────────┘ no answer for 2 s
"""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from edge_unit.joints import JointHistory
from edge_unit.sources.frame import CameraInfo
from edge_unit.uplink.assignment import Assignment, Delivery, LatestAssignment, Report, Trouble, seen_report
from edge_unit.uplink.cell_cache import CellCache
from edge_unit.uplink.client import MasterClient
from edge_unit.uplink.command_ledger import CommandLedger
from edge_unit.uplink.master_discovery import MasterSearch
from edge_unit.uplink.outbox import Outbox
from edge_unit.uplink.session import Session
from shared.cell import Cell
from shared.clock import NS_PER_S
from shared.errors import (
    CellError,
    CellwatchError,
    ConfigError,
    MasterRefused,
    MasterUnreachable,
    NewerContract,
    WireError,
)
from shared.messages import (
    CONTRACT_MINOR,
    CONTRACT_VERSION,
    DONE,
    CellReference,
    Command,
    Health,
    InitializeAnswer,
    InitializeRequest,
    Outcome,
    Phase,
    PoseQuality,
    ReportedOrigin,
    SlotAnswer,
    UpdateAnswer,
    UpdateRequest,
    Versions,
    matrix_of,
)
from shared.timebase import ClockOffset
from shared.transforms import Transform, validated
from shared.waiting import LOOP_CLOCK, Clock, sleep
from shared.wire import decode

logger = logging.getLogger(__name__)

RETRY_MIN_S = 0.05
RETRY_MAX_S = 0.25
"""Pauses between attempts. A master that returns has its units back within a second, even if a connection attempt has
just failed."""

JOINTS_TIMEOUT_S = 0.02
"""Timeout of a request for joints newer than those of the last update. A frame waits no longer for them."""

NOT_OURS = frozenset({400, 401, 403, 404, 405, 426})
"""Statuses of a refused registration: the host is no master, or a master of another contract or token."""

CONTRACT_RETRY_MIN_S, CONTRACT_RETRY_MAX_S = 5.0, 300.0
"""Pauses before this unit registers again at a newer master that it does not understand and that reports no change.

Each pause is twice the one before. Only two things help: an update of the unit, which restarts it, or a change at the
master, which the master reports.
"""

START_OVER = frozenset({401, 403, 404, 409})
"""Statuses after which the unit registers again: the master does not know its token, unit, session or address."""


@dataclass(frozen=True)
class _NotUnderstood:
    """A session with a newer master whose settings or cell this unit does not understand completely."""

    session: int
    versions: Versions
    trouble: Trouble
    retry_at_ns: int
    reported: bool = False


@dataclass
class _Logged:
    """The last logged errors, so that a retry does not log them again; also the last pause and the master's origin."""

    complaint: str = ""
    refused: str = ""
    contract_retry_s: float = CONTRACT_RETRY_MIN_S
    found_by: str = ""


@dataclass
class CameraState:
    """The camera's trouble and warning. Each update has them, and they replace those of the report's frame."""

    trouble: Trouble | None = None
    warning: str | None = None

    def facts(self) -> dict[str, Any]:
        """Return trouble and warning as fields of `Health`, or an empty dict if there are none."""
        facts = {} if self.trouble is None else self.trouble.facts()
        return facts if self.warning is None else facts | {"warning": self.warning}


class _RegisteringCamera(NamedTuple):
    """The camera to register with, and the pose to report to the master: `T_world_camera` and its origin."""

    camera: CameraInfo
    known_pose: tuple[Transform, ReportedOrigin] | None


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
        clock: Clock = LOOP_CLOCK,
    ) -> None:
        """Set `on_sent`, which is called for each report with its delivery, or with None if the report was dropped.

        `search` finds the master's address. Without it the client keeps its URL. `clock` is the unit's clock; it does
        not apply to the timeouts of the client's requests.
        """
        self._client = client
        self._time = clock
        self.search = search
        self._cells = cells
        self._program = software, boot_id
        self._registering_camera: _RegisteringCamera | None = None
        self._outbox = Outbox(on_sent, clock)
        self._ledger = CommandLedger()
        self._session = Session()
        self._latest = LatestAssignment()
        self._not_understood: _NotUnderstood | None = None
        self._logged = _Logged()
        self.phase: Phase | None = None
        self.joints = JointHistory()
        self.camera_state = CameraState()

    @property
    def assignment(self) -> Assignment | None:
        """Return the master's assignment, or None while the unit is not registered."""
        return self._latest.value

    @property
    def assigned(self) -> asyncio.Event:
        """Return the event that is set while there is an assignment."""
        return self._latest.available

    @property
    def commands(self) -> asyncio.Queue[Command]:
        """Return the queue of the master's commands that are not taken yet."""
        return self._ledger.waiting

    @property
    def clock(self) -> ClockOffset:
        """Return the offset of the master's clock from the unit's clock in this session."""
        return self._session.clock

    # ------------------------------------------------------------------ calls of the unit

    def set_camera(self, camera: CameraInfo, known_pose: tuple[Transform, ReportedOrigin] | None) -> None:
        """Set the camera to register with. If it differs from the one before, register again.

        `known_pose` (`T_world_camera` and its origin) is reported to the master, which can answer with another pose.
        """
        before = None if self._registering_camera is None else self._registering_camera.camera
        if before is not None and (before.serial, before.intrinsics) != (camera.serial, camera.intrinsics):
            self._start_over()
        self._registering_camera = _RegisteringCamera(camera, known_pose)
        self._outbox.wake()

    def offer(self, report: Report) -> None:
        """Send `report` next. An earlier report that is not sent yet is dropped."""
        self._outbox.offer(report)

    def finish(self, command: Command, outcome: Outcome = DONE) -> None:
        """Report the outcome of `command` with the next update. May be called from any thread."""
        self._ledger.finish(command, outcome)

    async def send_image(self, command: Command, png: bytes) -> None:
        """Send the image that `command` requested. Raises as `MasterClient.update`."""
        assert command.image is not None
        await self._client.put_image(self._session.id, command.image, command.id, png)

    async def report_pose(self, T_world_camera: Transform, origin: str, quality: PoseQuality) -> None:
        """Report the camera's measured pose to the master, and use it from the next frame on.

        Raises:
            UplinkError: the master did not answer, or refused the pose.
            WireError: the answer is not valid.
        """
        assignment = self.assignment
        version = await self._client.put_pose(self._session.id, T_world_camera, origin, quality)
        if assignment is not None and self.assignment is not None and self.assignment.session == assignment.session:
            versions = self.assignment.versions.model_copy(update={"pose": version})
            self._assign(replace(self.assignment, versions=versions, T_world_camera=T_world_camera))

    @property
    def status_text(self) -> str:
        """Return the state of the connection to the master as a sentence."""
        if self.search is not None and not self._client.url:
            return f"no master: {self.search.outcome}"
        if self._logged.complaint:
            return f"no master: {self._logged.complaint}"
        if self._not_understood is not None:
            return self._not_understood.trouble.sentence
        if self.assignment is None:
            return f"not registered yet at {self._client.url}"
        return f"unit {self._session.id} at {self._client.url}"

    async def drained(self, timeout_s: float) -> None:
        """Wait until all reports are sent, at most `timeout_s`."""
        await self._outbox.drained(timeout_s)

    async def refresh_joints(self, at_master_ns: int) -> None:
        """Request joints up to `at_master_ns`, unless they are known. A failed or late answer has no effect."""
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
                await self._select_master()
                assignment = self.assignment
                if self._not_understood is not None:
                    await self._report_not_understood(self._not_understood)
                elif assignment is None:
                    await self._register()
                else:
                    await self._report(assignment)
                retry_s, self._logged.complaint = RETRY_MIN_S, ""
                if self.search is not None:
                    self.search.answered(self._client.url)
                if self.phase == "searching" and self.assignment is not None:
                    self._enter(self.assignment.phase, f"{self._client.url} answers again")
            except MasterRefused as error:
                registered = self.assignment is not None or self._not_understood is not None
                if error.status in START_OVER and registered:
                    self._start_over()
                self._note_failure(error, error.status in NOT_OURS and self.assignment is None)
                retry_s = await self._wait(retry_s, error)
            except CellwatchError as error:
                foreign = isinstance(error, WireError) and self.assignment is None and self._not_understood is None
                if isinstance(error, (WireError, CellError)) and self._session.master_minor > CONTRACT_MINOR:
                    # If the new registration fails in the same way, it is reported as trouble.
                    self._start_over()
                self._note_failure(error, foreign or isinstance(error, MasterUnreachable))
                retry_s = await self._wait(retry_s, error)

    async def _select_master(self) -> None:
        """Set the client to the master that the search found. Wait while no master is known."""
        if self.search is None:
            return
        if not self._client.url:
            self._enter("searching", self.search.outcome)
        address = await self.search.address()
        if address.url != self._client.url:
            self._client.set_url(address.url)
            self._logged.found_by = address.found_by
            self._start_over()

    def _note_failure(self, error: CellwatchError, lost: bool) -> None:
        """Note a failed exchange. With `lost` the master may have another address, and the search is informed."""
        if self.search is not None and lost:
            self.search.unanswered(self._time.now_ns())
            if self.search.lost:
                self._enter("searching", str(error))

    def _enter(self, phase: Phase, reason: str) -> None:
        """Change to `phase`, and log the change with `reason`."""
        if phase != self.phase:
            before = f"{self.phase} → " if self.phase else ""
            logger.info("%s%s: %s", before, phase, reason)
            self.phase = phase

    async def _register(self) -> None:
        if self.search is None or not self.search.lost:
            self._enter(
                "registering", f"at {self._client.url}{f', {self._logged.found_by}' if self._logged.found_by else ''}"
            )
        while self._registering_camera is None:
            await self._outbox.woken(heartbeat=False)
        camera, known_pose = self._registering_camera
        await self._client.authorize()
        reported, origin = known_pose or (None, "configured")
        software, boot_id = self._program
        sent_at_ns = self._time.now_ns()
        request = InitializeRequest(
            contract=CONTRACT_VERSION,
            contract_minor=CONTRACT_MINOR,
            serial=camera.serial,
            model=camera.model,
            intrinsics=camera.intrinsics,
            software=software,
            boot_id=boot_id,
            T_world_camera=None if reported is None else matrix_of(reported),
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
        """Begin the session that was requested at `sent_at_ns`, and clear the state of the one before."""
        self._session = Session.begun(slot, sent_at_ns, self._time.now_ns())
        self.joints.clear()
        self._ledger.clear()

    def _refuse(self, slot: InitializeAnswer | SlotAnswer, error: CellwatchError) -> None:
        """Do not follow a newer master that is not understood: an unknown field may forbid to filter something."""
        theirs, ours = f"{CONTRACT_VERSION}.{slot.contract_minor}", f"{CONTRACT_VERSION}.{CONTRACT_MINOR}"
        trouble = Trouble("contract", f"update this unit: it speaks contract {ours}, its master {theirs}: {error}")
        # The same trouble as before: the last registration did not help.
        known = trouble.sentence == self._logged.refused
        retry_s = min(2.0 * self._logged.contract_retry_s, CONTRACT_RETRY_MAX_S) if known else CONTRACT_RETRY_MIN_S
        self._logged.contract_retry_s = retry_s
        retry_at_ns = self._time.now_ns() + round(retry_s * NS_PER_S)
        self._not_understood = _NotUnderstood(slot.session, slot.versions, trouble, retry_at_ns)
        level = logging.DEBUG if known else logging.WARNING
        logger.log(level, "%s", trouble.sentence)
        self._logged.refused = trouble.sentence

    async def _report_not_understood(self, not_understood: _NotUnderstood) -> None:
        """Report the trouble instead of frames. Register again after a change at the master or the retry pause."""
        self._outbox.drop()
        # The first report is sent at once. Until it arrives, the master knows only that this unit registered.
        if not_understood.reported:
            await self._outbox.woken()
            self._outbox.drop()
        sent_at_ns = self._time.now_ns()
        if sent_at_ns > not_understood.retry_at_ns:
            self._start_over()
            return
        answer = await self._client.update(
            UpdateRequest(
                id=self._session.id,
                session=not_understood.session,
                sequence=self._session.next_sequence(),
                sent_at_ns=sent_at_ns,
                exchange=self._session.exchange,
                # The unit does not use these versions, but confirms them, so the master does not send their content.
                versions=not_understood.versions,
                health=Health().model_copy(update=not_understood.trouble.facts()),
                phase="fetching",
            )
        )
        self._session.note(sent_at_ns, answer, self._time.now_ns())
        self._not_understood = replace(not_understood, reported=True)
        if answer.versions != not_understood.versions:
            self._start_over()

    async def _get_cell(self, reference: CellReference) -> Cell:
        cell = await self._cells.get(reference, self._client)
        if self.search is not None:
            await self.search.keep(self._client.url, reference.name)
        return cell

    async def _report(self, assignment: Assignment) -> None:
        """Send the latest report, or the one before again if there is no new one."""
        if self._outbox.empty:
            await self._outbox.woken()
        fresh = self._outbox.take()
        report = fresh or self._outbox.last or Report(assignment)
        if report.assignment.session != assignment.session:
            # The report belongs to an earlier session, in which the same versions can mean something else.
            if fresh is not None:
                self._outbox.sent(fresh, None)
            report = Report(assignment)
        self._outbox.last = report
        try:
            answer, delivery = await self._exchange_update(assignment, report)
        except CellwatchError:
            self._outbox.put_back(fresh)
            raise
        finally:
            self._outbox.settle()
        if fresh is not None:
            self._outbox.sent(fresh, delivery)
        await self._apply_answer(assignment, answer)

    async def _exchange_update(self, assignment: Assignment, report: Report) -> tuple[UpdateAnswer, Delivery]:
        session, versions = self._session, report.assignment.versions
        seen_bits = report.seen.packed() if report.seen is not None else b""
        seen = None
        if report.seen is not None and session.acknowledged != (versions, seen_bits):
            seen = seen_report(report.seen)
            # Until the master answers, it is unknown which of the two seen reports it has.
            session.acknowledged = None
        done = self._ledger.ended()
        health = report.health.model_copy(update=self.camera_state.facts())
        sent_at_ns = self._time.now_ns()
        answer = await self._client.update(
            UpdateRequest(
                id=session.id,
                session=assignment.session,
                sequence=session.next_sequence(),
                captured_at_ns=report.captured_at_ns,
                sent_at_ns=sent_at_ns,
                exchange=session.exchange,
                versions=versions,
                keys=report.keys,
                seen=seen,
                health=health,
                joints_until_ns=self.joints.newest_ns,
                done=done,
                phase=assignment.phase,
            )
        )
        session.note(sent_at_ns, answer, self._time.now_ns())
        self.joints.add(answer.joints)
        if report.seen is not None:
            session.acknowledged = versions, seen_bits
        self._ledger.forget(done)
        offset_ns = session.clock.offset_ns
        return answer, Delivery(sent_at_ns, answer.received_at_ns - offset_ns, answer.answered_at_ns - offset_ns)

    async def _apply_answer(self, assignment: Assignment, answer: UpdateAnswer) -> None:
        """Accept the commands of the master's answer, and apply its changes to the assignment."""
        self._ledger.accept(answer.commands)
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
            # Otherwise the camera was replaced meanwhile, and this session has ended.
            self._assign(changed)

    def _assign(self, assignment: Assignment, how: str = "") -> None:
        self._latest.set(assignment)
        known = "not known yet" if assignment.T_world_camera is None else "known"
        self._enter(assignment.phase, f"{how}the pose of its camera is {known}")

    def _start_over(self) -> None:
        self._latest.clear()
        self._not_understood = None

    async def _wait(self, retry_s: float, error: CellwatchError) -> float:
        """Wait before the next attempt, and return the pause after that one."""
        # Each different error is logged once, for example no answer and then a wrong certificate.
        new = retry_s == RETRY_MIN_S or str(error) != self._logged.complaint
        self._logged.complaint = str(error)
        level = logging.WARNING if new or isinstance(error, ConfigError) else logging.DEBUG
        logger.log(level, "%s", error)
        await sleep(retry_s * random.uniform(0.8, 1.2), self._time)
        return min(2.0 * retry_s, RETRY_MAX_S)
