# SPDX-License-Identifier: Apache-2.0
"""The units' slots (Algorithm 8), and the trust in each unit's current report."""

from __future__ import annotations

import logging
import math
import secrets
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field

from master_server.core.merged_map import MAX_WITNESSES
from master_server.persistence import Store, UnitRecord
from shared.clock import NS_PER_MS, NS_PER_S
from shared.errors import Refusal
from shared.messages import (
    MAX_COMMANDS,
    OPEN,
    Command,
    CommandRow,
    Health,
    ImageKind,
    InitializeRequest,
    Matrix,
    Outcome,
    Phase,
    PoseOrigin,
    PoseQuality,
    Reason,
    ReasonCode,
    State,
    UnitRow,
    UpdateRequest,
    Verb,
    Versions,
)
from shared.settings import Settings
from shared.timebase import ClockOffset
from shared.transforms import angle_rad, inverse

logger = logging.getLogger(__name__)

MAX_UNITS = 64
"""More cameras than in any cell known to us; bounds the tables, and the witnesses of a voxel."""

assert MAX_UNITS <= MAX_WITNESSES

REFINED_MM, REFINED_DEG = 100.0, 5.0
"""A refined pose differs at most this much from the unit's configured pose: refinement goes no farther."""

FPS_FRAMES = 31
"""Frames over which the frame rate is computed: two seconds at 15 fps."""

FUTURE_TOLERANCE_NS = 5 * NS_PER_MS
"""A capture time may lie this far in the future, beyond the uncertainty of the clock."""

BLIND_VALID_SHARE = 0.05
"""A covered lens measures nothing; the emptiest honest view of a cell still measures a fifth of its pixels."""

MOVED_AGREEING_SHARE = 0.1
"""A camera that was turned agrees with its static surfaces only by chance; a crowd in front of it hides less."""

MOVED_STATIC_SHARE = 0.1
"""With fewer pixels on known surfaces, a moved camera cannot be detected."""

SILENT: tuple[ReasonCode, ...] = ("no_update", "late_update")
"""The unit is silent: its earlier report does not count."""

COMMAND_EXPIRES_S = 600.0
"""Learning the background at one frame a second takes minutes; without an answer after ten, none will come."""

CONFIGURED_ORIGINS = ("configured", "source")
"""Origins of poses in the unit's configuration: a later one replaces them. A pose measured or set here stays."""

IMAGE_EXPIRES_S = 5.0
"""The unit needs one frame and one update for it; a user in front of a browser waits no longer."""


@dataclass(frozen=True)
class UnitState:
    """One unit in a message of the stream."""

    # Readers ignore fields that a later master adds, also in a message that forbids extra fields.
    __pydantic_config__ = ConfigDict(extra="ignore")

    id: int
    ip: str
    state: Annotated[State, OPEN]
    reason: str
    cause: Annotated[Reason | None, Field(description="The reason for programs.")]
    age_s: Annotated[float | None, Field(description="Seconds since the capture of its last frame.")]
    voxels: int


@dataclass
class _PendingCommand:
    """A command that the unit has not answered yet."""

    command: Command
    expires_at_ns: int
    on_end: Callable[[Outcome], None] | None = None

    @property
    def unanswered(self) -> Outcome:
        """Return the outcome of a command that the unit did not answer in time."""
        limit_s = IMAGE_EXPIRES_S if self.command.verb == "image" else COMMAND_EXPIRES_S
        return Outcome("unanswered", f"the unit did not answer within {limit_s:g} s")


@dataclass
class Session:
    """The unit's reports since it registered. Times of the unit are by the unit's clock."""

    configured_pose: Matrix | None = None
    registered: bool = False
    phase: Phase = "registering"
    versions: Versions = field(default_factory=Versions)
    # Random, so that a session of an earlier master is never mistaken for a current one.
    number: int = field(default_factory=lambda: secrets.randbits(32))
    sequence: int = -1
    clock: ClockOffset = field(default_factory=ClockOffset)
    arrived_at_ns: int | None = None
    captured_at_ns: int | None = None
    captures_ns: deque[int] = field(default_factory=lambda: deque(maxlen=FPS_FRAMES))
    health: Health = field(default_factory=Health)
    contract_minor: int | None = None

    def store_update(self, update: UpdateRequest, now_ns: int) -> None:
        """Store the unit's newest update, which arrived at `now_ns`."""
        self.sequence = update.sequence
        self.arrived_at_ns = now_ns
        self.versions = update.versions
        self.health = update.health
        self.phase = update.phase
        if update.exchange is not None:
            self.clock.add(update.exchange)
        if update.captured_at_ns != self.captured_at_ns and update.captured_at_ns is not None:
            self.captures_ns.append(update.captured_at_ns)
        self.captured_at_ns = update.captured_at_ns

    def age_s(self, now_ns: int) -> float | None:
        """Return the seconds from the last frame's capture to the master's `now_ns`; None while unknown."""
        if self.captured_at_ns is None or not self.clock.known:
            return None
        return (now_ns - self.captured_at_ns - self.clock.offset_ns) / NS_PER_S

    def arrival_age_s(self, now_ns: int) -> float | None:
        """Return the seconds since an update arrived."""
        return None if self.arrived_at_ns is None else (now_ns - self.arrived_at_ns) / NS_PER_S

    def is_silent(self, now_ns: int, after_s: float) -> bool:
        """Return True if no update came for `after_s`."""
        arrival_age_s = self.arrival_age_s(now_ns)
        return arrival_age_s is None or arrival_age_s > after_s

    def expires_at_ns(self, stale_after_s: float) -> int | None:
        """Return the time, by the master's clock, at which its last view is stale; None without a view."""
        if self.arrived_at_ns is None or self.captured_at_ns is None or not self.clock.known:
            return None
        newest_ns = min(self.arrived_at_ns, self.captured_at_ns + self.clock.offset_ns)
        return newest_ns + round(stale_after_s * NS_PER_S)

    def clock_uncertainty_ns(self, now_ns: int) -> int | None:
        """Return the uncertainty of `age_s`."""
        return self.clock.uncertainty_ns(now_ns - self.clock.offset_ns) if self.clock.known else None

    @property
    def fps(self) -> float:
        """Return the frames per second over the last few frames."""
        captures = self.captures_ns
        if len(captures) < 2 or captures[-1] <= captures[0]:
            return 0.0
        return (len(captures) - 1) * NS_PER_S / (captures[-1] - captures[0])


@dataclass
class Slot:
    """All state of the one camera behind an IP, except its reports, which `MergedMap` and `Coverage` hold."""

    record: UnitRecord
    session: Session = field(default_factory=Session)
    warning: str = ""
    pending: deque[_PendingCommand] = field(default_factory=deque)
    last_command: CommandRow | None = None
    logged_state: State | None = None
    updates: int = 0
    received_bytes: int = 0

    id: int = field(init=False)
    ip: str = field(init=False)
    T_world_camera: Matrix | None = field(init=False)
    pose_version: int = field(init=False)

    def __post_init__(self) -> None:
        self.set_record(self.record)

    def set_record(self, record: UnitRecord) -> None:
        """Replace the stored record of the slot."""
        self.record = record
        # Cached, since each update needs these.
        self.id, self.ip = record.id, record.ip
        self.T_world_camera, self.pose_version = record.T_world_camera, record.pose_version
        self.warning = _pose_warning(record, self.session.configured_pose)

    def begin_session(self, configured_pose: Matrix | None, contract_minor: int | None = None) -> None:
        """Start a session for the unit that registered; all of its earlier reports are void."""
        self.session = Session(
            configured_pose,
            registered=True,
            phase="fetching",
            versions=self.session.versions,
            contract_minor=contract_minor,
        )
        self.warning = _pose_warning(self.record, configured_pose)

    @property
    def serial(self) -> str:
        """Serial number of the camera."""
        return self.record.serial

    @property
    def commands(self) -> tuple[Command, ...]:
        """Commands that the unit has not answered yet, the oldest first."""
        return tuple(entry.command for entry in self.pending)

    def expire(self, now_ns: int) -> None:
        """End the commands that the unit did not answer in time."""
        for entry in self._overdue(now_ns):
            self.end(entry.command.id, entry.unanswered)

    def end(self, command_id: int, outcome: Outcome) -> None:
        """End a command; does nothing if it had ended before."""
        for entry in [entry for entry in self.pending if entry.command.id == command_id]:
            self.pending.remove(entry)
            if entry.on_end is not None:
                entry.on_end(outcome)
            verb = entry.command.verb
            level = logging.DEBUG if verb == "image" else logging.INFO
            fields = {**self.log_fields("command"), "verb": verb, "code": outcome.code}
            gained = f": {outcome.detail}" if outcome.code == "done" and outcome.detail else ""
            logger.log(
                level,
                "unit %d (%s): command %d, %s: %s%s",
                self.id,
                self.ip,
                command_id,
                verb,
                outcome.sentence,
                gained,
                extra=fields,
            )
            if self.last_command is not None and self.last_command.id == command_id:
                self.last_command = self.last_command.ended(outcome)

    def log_state(self, state: State, cause: Reason | None) -> None:
        """Log a change of its state."""
        reason = sentence_of(cause)
        level = logging.INFO if state == "live" else logging.WARNING
        before = f"{self.logged_state} → " if self.logged_state else ""
        why = f": {reason}" if reason else ""
        fields = {**self.log_fields("state"), "state": state, "reason": reason, "code": cause.code if cause else ""}
        logger.log(level, "unit %d (%s): %s%s%s", self.id, self.ip, before, state, why, extra=fields)
        self.logged_state = state

    def log_fields(self, event: str) -> dict[str, object]:
        """Return the structured fields of a log line about this unit."""
        return {"event": event, "unit_id": self.id, "ip": self.ip}

    def judge(self, now_ns: int, current: Versions, settings: Settings) -> tuple[State, Reason | None]:
        """Return the unit's state, and the reason if it is not live, or a warning if it is.

        `current` has the versions of the master; its pose version is not used, since each slot has its own.
        """
        if self.T_world_camera is None:
            return "uncalibrated", self._without_pose()
        if stale := self._stale(now_ns, current, settings):
            return "stale", self._with_reported_trouble(stale)
        health = self.session.health
        if health.trouble:
            return "blind", self._with_progress(health.trouble)
        if health.blind:
            return "blind", Reason("covered", health.blind)
        if health.valid_share < BLIND_VALID_SHARE:
            numbers = {"valid_share": health.valid_share, "limit_share": BLIND_VALID_SHARE}
            text = f"only {health.valid_share:.0%} of its pixels measure anything"
            return "blind", Reason("few_pixels", text, numbers)
        if health.moved:
            return "moved", Reason("moved", health.moved)
        if health.static_share >= MOVED_STATIC_SHARE and health.agreeing_share < MOVED_AGREEING_SHARE:
            numbers = {"agreeing_share": health.agreeing_share, "limit_share": MOVED_AGREEING_SHARE}
            text = f"only {health.agreeing_share:.0%} of the known surfaces are where they should be"
            return "moved", Reason("few_surfaces", text, numbers)
        if self.warning:
            text = f"{self.warning}; {health.warning}" if health.warning else self.warning
            return "live", Reason("pose_differs", text)
        return "live", Reason("warning", health.warning) if health.warning else None

    def row(self, now_ns: int, state: State, cause: Reason | None, voxels: int, range_m: float | None) -> UnitRow:
        """Return its row of `GET /units`."""
        session = self.session
        age_s, arrival_age_s = session.age_s(now_ns), session.arrival_age_s(now_ns)
        uncertainty_ns = session.clock_uncertainty_ns(now_ns)
        return UnitRow(
            id=self.id,
            ip=self.ip,
            serial=self.serial,
            model=self.record.model,
            software=self.record.software,
            state=state,
            reason=sentence_of(cause),
            cause=cause,
            phase=session.phase,
            age_s=None if age_s is None else round(age_s, 4),
            arrival_age_s=None if arrival_age_s is None else round(arrival_age_s, 4),
            clock_uncertainty_ms=None if uncertainty_ns is None else round(uncertainty_ns / NS_PER_MS, 3),
            fps=round(session.fps, 2),
            voxels=voxels,
            process_ms=session.health.process_ms,
            frame_number=session.health.frame,
            health=session.health,
            T_world_camera=self.T_world_camera,
            pose_origin=self.record.pose_origin,
            pose_quality=self.record.pose_quality,
            intrinsics=self.record.intrinsics,
            range_m=range_m,
            versions=session.versions,
            contract_minor=session.contract_minor,
            last_command=self._last_command(now_ns),
        )

    def _last_command(self, now_ns: int) -> CommandRow | None:
        """Return the last command with its outcome at `now_ns`, even if `tick` has not noticed that outcome yet."""
        last = self.last_command
        for entry in self._overdue(now_ns):
            if last is not None and last.id == entry.command.id:
                return last.ended(entry.unanswered)
        return last

    def _overdue(self, now_ns: int) -> list[_PendingCommand]:
        return [entry for entry in self.pending if entry.expires_at_ns <= now_ns]

    def _without_pose(self) -> Reason:
        """Return the reason why the pose of its camera is unknown."""
        if self.record.note:
            is_old = self.session.health.trouble_code == "contract"
            return Reason("contract" if is_old else "pose_void", self.record.note)
        if self.session.health.trouble:
            return self._with_progress(self.session.health.trouble)
        return Reason("no_pose", "its pose is not known yet")

    def _with_progress(self, sentence: str) -> Reason:
        """Return the trouble that the unit reports, with its progress if it is one that passes."""
        progress = self.session.health.progress
        numbers = {"done": float(progress.done), "total": float(progress.total)} if progress else {}
        return Reason(self.session.health.trouble_code or "trouble", sentence, numbers)

    def _with_reported_trouble(self, stale: Reason) -> Reason:
        """Add the unit's reported trouble to a reason; a unit of an older contract is not merely late."""
        trouble = self.session.health.trouble
        if not trouble:
            return stale
        is_old = self.session.health.trouble_code == "contract" and stale.code not in SILENT
        return Reason("contract" if is_old else stale.code, f"{stale.sentence} ({trouble})", stale.numbers)

    def _stale(self, now_ns: int, current: Versions, settings: Settings) -> Reason | None:
        """Return the reason why its last view does not count now; None if it does."""
        limit_s = settings.stale_after_s
        session = self.session
        arrival_age_s, age_s = session.arrival_age_s(now_ns), session.age_s(now_ns)
        uncertainty_ns = session.clock_uncertainty_ns(now_ns)
        if arrival_age_s is None:
            since = "it registered" if session.registered else "the master started"
            return Reason("no_update", f"no update since {since}")
        if arrival_age_s > limit_s:
            text = f"its last update came {arrival_age_s:.1f} s ago, at most {limit_s:g} s are trusted"
            return Reason("late_update", text, {"age_s": round(arrival_age_s, 1), "limit_s": limit_s})
        if session.captured_at_ns is None:
            return Reason("no_frame", "no frame yet")
        if age_s is None or uncertainty_ns is None:
            return Reason("clock_unknown", "its clock is not known yet")
        if uncertainty_ns > limit_s * NS_PER_S:
            text = f"its clock is known to {uncertainty_ns / NS_PER_S:.1f} s only"
            numbers = {"uncertainty_s": round(uncertainty_ns / NS_PER_S, 1), "limit_s": limit_s}
            return Reason("clock_uncertain", text, numbers)
        if age_s > limit_s:
            text = f"its last frame is {age_s:.1f} s old, at most {limit_s:g} s are trusted"
            return Reason("late_frame", text, {"age_s": round(age_s, 1), "limit_s": limit_s})
        if age_s * NS_PER_S < -(uncertainty_ns + FUTURE_TOLERANCE_NS):
            text = f"its last frame seems to be of {-age_s:.3f} s from now: its clock jumped"
            return Reason("clock_jumped", text, {"ahead_s": round(-age_s, 3)})
        if session.versions.lattice != current.lattice:
            text = "it does not work on the current lattice yet"
            return _behind("old_lattice", text, session.versions.lattice, current.lattice)
        if session.versions.cell != current.cell:
            text = "it does not work with the current cell yet"
            return _behind("old_cell", text, session.versions.cell, current.cell)
        if session.versions.pose != self.pose_version:
            text = "it does not work with its current pose yet"
            return _behind("old_pose", text, session.versions.pose, self.pose_version)
        return None


class Registry:
    """All slots, one for each IP, allocated once. Each change is stored before it takes effect."""

    def __init__(self, store: Store, units: Iterable[UnitRecord] = (), last_id: int = 0) -> None:
        """Start with the stored `units`, and the last id that was ever given."""
        self._store = store
        self._slots = {unit.id: Slot(unit) for unit in units}
        self._by_ip = {slot.ip: slot for slot in self._slots.values()}
        self._last_id = last_id
        self._last_command = 0

    def __iter__(self) -> Iterator[Slot]:
        return iter(self._slots.values())

    def __len__(self) -> int:
        return len(self._slots)

    def initialize(
        self, request: InitializeRequest, ip: str, now_ns: int, stale_after_s: float
    ) -> tuple[Slot, list[Slot]]:
        """Return the slot of this IP with a new session, and the slots that were retired for it.

        A camera that appears behind another IP retires its old slot once that is silent for `stale_after_s`. Without
        this delay, two cameras of one serial would evict each other for ever, and so would two cameras behind one IP.
        Its pose moves with it only within one boot of the unit, since then only the address changed. Another camera in
        a slot makes the pose void. A pose from the unit's configuration replaces only a pose of that origin. A camera
        that takes the slot of another does not delete the other: that one is expected in the old slot of the first.
        Units that exchanged addresses come one after the other, and one that does not come back must be missed.

        Raises:
            Refusal: 409, the camera reports from another IP now, or another camera from this IP; 503, there are
                MAX_UNITS already; 507, the change cannot be stored.
        """
        elsewhere = [slot for slot in self if slot.serial == request.serial and slot.ip != ip]
        for old in elsewhere:
            if not old.session.is_silent(now_ns, stale_after_s):
                raise Refusal(409, f"camera {request.serial} reports from IP {old.ip} (unit {old.id}) at this moment")
        slot = self._by_ip.get(ip)
        if slot is not None and slot.serial != request.serial and not slot.session.is_silent(now_ns, stale_after_s):
            raise Refusal(
                409,
                f"camera {request.serial}: camera {slot.serial} reports from IP {ip} (unit {slot.id}) at this moment; "
                "each unit needs an IP of its own",
            )
        if slot is None and len(self) - len(elsewhere) >= MAX_UNITS:
            raise Refusal(503, f"no free slot: expected at most {MAX_UNITS} units; delete one that is gone")
        record = _registered(request, ip, self._last_id + 1 if slot is None else slot.record, elsewhere)
        moved = elsewhere[:1] if slot is not None and slot.serial != request.serial else []
        retired = elsewhere[len(moved) :]
        left = [_expected_elsewhere(old.record, slot.record, ip) for old in moved if slot is not None]
        if slot is None or elsewhere or record != slot.record:
            try:
                self._store.save_units([record, *left], [old.id for old in retired])
            except Refusal:
                if slot is None or elsewhere or record.pose_version != slot.pose_version:
                    raise
                # Only its software or its boot changed, which is no reason to drop its view of the cell.
                record = slot.record
        for old in elsewhere:
            logger.warning(
                "unit %d (%s): camera %s is at %s now", old.id, old.ip, old.serial, ip, extra=old.log_fields("camera")
            )
        for old in retired:
            self._drop(old)
        for old, expecting in zip(moved, left, strict=True):
            old.set_record(expecting)
            old.begin_session(None)
        if slot is None:
            self._last_id = record.id
            slot = self._slots[record.id] = self._by_ip[ip] = Slot(record)
        elif slot.serial != record.serial:
            logger.warning("unit %d (%s): %s", slot.id, ip, record.note, extra=slot.log_fields("camera"))
        slot.set_record(record)
        slot.begin_session(request.T_world_camera, request.contract_minor)
        if slot.warning:
            logger.warning("unit %d (%s): %s", slot.id, ip, slot.warning, extra=slot.log_fields("pose"))
        return slot, elsewhere

    def set_pose(
        self, slot: Slot, T_world_camera: Matrix, origin: PoseOrigin, quality: PoseQuality | None = None
    ) -> None:
        """Set the camera's pose.

        Raises:
            Refusal: 507, it cannot be stored; nothing is changed.
        """
        record = slot.record.with_pose(T_world_camera, origin, quality=quality)
        self._store.save_units([record])
        slot.set_record(record)

    def get(self, unit_id: int) -> Slot:
        """Return the slot with this id.

        Raises:
            Refusal: 404, the unit is unknown.
        """
        slot = self._slots.get(unit_id)
        if slot is None:
            raise Refusal(404, f"unit {unit_id}: not known here; initialize first")
        return slot

    def own(self, unit_id: int, ip: str) -> Slot:
        """Return the slot with this id, which must be the caller's.

        Raises:
            Refusal: 404, the unit is unknown; 403, it has another IP.
        """
        slot = self.get(unit_id)
        if slot.ip != ip:
            raise Refusal(403, f"unit {unit_id}: it has another IP than {ip}")
        return slot

    def remove(self, unit_id: int) -> None:
        """Delete a unit.

        Raises:
            Refusal: 404, the unit is unknown; 507, the change cannot be stored.
        """
        slot = self.get(unit_id)
        self._store.save_units([], [unit_id])
        self._drop(slot)

    def send_command(
        self,
        slot: Slot,
        verb: Verb,
        now_ns: int,
        image: ImageKind | None = None,
        raw: bool = False,
        on_end: Callable[[Outcome], None] | None = None,
    ) -> Command:
        """Send a command to a unit with the answer to its next update. `on_end` receives the outcome.

        Raises:
            Refusal: 409, too many commands wait for it already, or the unit does not understand this master.
        """
        slot.expire(now_ns)
        health = slot.session.health
        if health.trouble_code == "contract":
            raise Refusal(409, f"unit {slot.id}: it takes no commands of this master: {health.trouble}")
        if len(slot.pending) >= MAX_COMMANDS:
            raise Refusal(409, f"unit {slot.id}: {MAX_COMMANDS} commands wait for it already")
        self._last_command += 1
        command = Command(id=self._last_command, verb=verb, image=image, raw=raw)
        expires_s = IMAGE_EXPIRES_S if verb == "image" else COMMAND_EXPIRES_S
        slot.pending.append(_PendingCommand(command, now_ns + round(expires_s * NS_PER_S), on_end))
        if verb != "image":
            slot.last_command = CommandRow(id=command.id, verb=verb, outcome=None)
        return command

    def _drop(self, slot: Slot) -> None:
        del self._slots[slot.id], self._by_ip[slot.ip]


def sentence_of(cause: Reason | None) -> str:
    """Return a reason's sentence; empty without a reason."""
    return "" if cause is None else cause.sentence


def _behind(code: ReasonCode, sentence: str, version: int, current: int) -> Reason:
    """Return the reason for a unit that works with an old version."""
    return Reason(code, sentence, {"version": float(version), "current": float(current)})


def _registered(request: InitializeRequest, ip: str, before: UnitRecord | int, elsewhere: Iterable[Slot]) -> UnitRecord:
    """Return the record of a unit that registers: `before` is its old record, or the id of a new unit."""
    if isinstance(before, int):
        record = UnitRecord(id=before, ip=ip)
        for old in elsewhere:
            if old.T_world_camera is not None and old.record.boot_id and old.record.boot_id == request.boot_id:
                record = record.with_pose(old.T_world_camera, old.record.pose_origin, quality=old.record.pose_quality)
    elif before.serial != request.serial:
        note = f"the camera changed from {before.serial} to {request.serial}, so its pose is void"
        record = before.with_pose(None, None, note)
    else:
        record = before
    configured = request.T_world_camera
    if configured is not None and (
        record.T_world_camera is None
        or (record.pose_origin in CONFIGURED_ORIGINS and record.T_world_camera != configured)
    ):
        record = record.with_pose(configured, request.pose_origin)
    return record.model_copy(
        update={
            "serial": request.serial,
            "model": request.model,
            "software": request.software,
            "boot_id": request.boot_id,
            "intrinsics": request.intrinsics,
        }
    )


def _expected_elsewhere(left: UnitRecord, taken: UnitRecord, ip: str) -> UnitRecord:
    """Return the slot that a camera left for `ip`: the camera that was there is expected here, without a pose."""
    note = f"camera {left.serial} is at {ip} now, where camera {taken.serial} was; that one did not come back yet"
    return left.with_pose(None, None, note).model_copy(
        update={
            "serial": taken.serial,
            "model": taken.model,
            "software": "",
            "boot_id": "",
            "intrinsics": taken.intrinsics,
        }
    )


def _pose_warning(record: UnitRecord, configured: Matrix | None) -> str:
    """Return a warning if the unit's configured pose differs from the pose that counts; else an empty string."""
    if configured is None or record.T_world_camera is None or configured == record.T_world_camera:
        return ""
    known_pose, configured_pose = np.array(record.T_world_camera), np.array(configured)
    shift_mm = 1e3 * float(np.linalg.norm(known_pose[:3, 3] - configured_pose[:3, 3]))
    turn_deg = math.degrees(angle_rad(inverse(known_pose) @ configured_pose))
    if record.pose_origin == "refined" and shift_mm <= REFINED_MM and turn_deg <= REFINED_DEG:
        return ""
    return (
        f"the unit's configuration has its camera {shift_mm:.0f} mm and {turn_deg:.1f}° from where it is by the pose "
        f"that counts ({record.pose_origin})"
    )
