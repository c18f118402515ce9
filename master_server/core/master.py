# SPDX-License-Identifier: Apache-2.0
"""The master without a network: slots, merge, coverage, robot, settings and cell in one place.

Every call receives the time; nothing here waits, reads a file or knows HTTP.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from master_server.cells.published import PublishedCell
from master_server.core.coverage import Coverage
from master_server.core.merged_map import NO_KEYS, MergedMap
from master_server.core.robot_joints import RobotJoints
from master_server.core.units import Registry, Slot, UnitState, sentence_of
from master_server.persistence import Store, startup_state
from shared.cell import Cell
from shared.configuration import sentence
from shared.errors import Refusal
from shared.lattice import Lattice
from shared.messages import (
    CONTRACT_MINOR,
    CONTRACT_VERSION,
    CellAnswer,
    Command,
    InitializeAnswer,
    InitializeRequest,
    JointsRequest,
    LatticeDescription,
    Matrix,
    PoseOrigin,
    PoseQuality,
    Reason,
    ReasonCode,
    RobotAnswer,
    State,
    UnitRow,
    UpdateAnswer,
    UpdateRequest,
    Verb,
    Versions,
    is_newer,
    matrix_of,
)
from shared.settings import Settings
from shared.transforms import validated
from shared.wire import keys_from_bytes

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MapView:
    """The merged map at one time: keys (N,) uint32 ascending, witnesses (N,) uint8, and its gaps.

    `reports` are the keys of each live unit by its id, from which the map was merged. `causes` are the reasons for
    programs, in the same order as `reasons` (recordings of contract 5.0 have none).
    """

    lattice: Lattice
    lattice_version: int
    keys: NDArray[np.uint32]
    witnesses: NDArray[np.uint8]
    reasons: tuple[str, ...]
    oldest_view_age_s: float | None
    units_live: int
    reports: Mapping[int, NDArray[np.uint32]] = field(default_factory=dict)
    causes: tuple[Reason, ...] = ()

    @property
    def complete(self) -> bool:
        """True if each unreported voxel in a seen block holds nothing unknown."""
        return not self.reasons


class Master:
    """The state of the master and all calls on it."""

    def __init__(self, cell: Cell, settings: Settings, store: Store | None = None) -> None:
        """Continue from the state in `store`; without a store, no state outlives this object.

        Where the configured `cell` and `settings` differ from the stored ones, `startup_state` decides.

        Raises:
            InputError: the cell needs too many voxels of the size in the settings.
            ConfigError: the store is damaged.
            CellError: a mesh is far too large and does not touch the box.
            Refusal: 507, the state at start cannot be stored.
        """
        self.store = Store.in_memory() if store is None else store
        saved = self.store.load()
        startup = startup_state(saved, cell, settings)
        self.published = PublishedCell.of(startup.cell)
        lattice = startup.cell.lattice(startup.settings.voxel_size_m)
        if startup.is_changed:
            self.store.begin(startup.cell, startup.cell_file, startup.settings, startup.configured, startup.versions)
        cell = startup.cell
        self.settings = settings = startup.settings
        self.versions = startup.versions
        self.registry = Registry(self.store, saved.units, saved.last_id)
        self.robot = RobotJoints(cell.robot.joint_names if cell.robot else None)
        self.listeners: list[Callable[[], None]] = []
        """Called after each change of what `view` says; time alone changes it too, see `next_change_ns`."""
        self._begin_on(lattice, cell.blocks(settings.seen_block_size_m))

    @property
    def cell(self) -> Cell:
        """The watched cell."""
        return self.published.cell

    # ------------------------------------------------------------------ units

    def initialize(self, request: InitializeRequest, ip: str, now_ns: int) -> InitializeAnswer:
        """Give a unit its slot (Algorithm 8).

        Raises:
            Refusal: the unit speaks another contract, its camera reports from another IP, another camera reports from
                this IP, there are too many units, or the change cannot be stored.
        """
        if request.contract != CONTRACT_VERSION or request.contract_minor > CONTRACT_MINOR:
            first = "the master" if is_newer(request.contract, request.contract_minor) else "the unit"
            raise Refusal(
                400,
                f"contract: this master speaks version {CONTRACT_VERSION}.{CONTRACT_MINOR}, the unit "
                f"{request.contract}.{request.contract_minor}; update {first} first",
            )
        slot, retired = self.registry.initialize(request, ip, now_ns, self.settings.stale_after_s)
        for gone in (slot, *retired):
            self._withdraw(gone.id)
        self._changed()
        return InitializeAnswer(
            id=slot.id,
            session=slot.session.number,
            versions=self._versions_for(slot),
            settings=self.settings,
            lattice=self.lattice_description,
            cell=self.published.reference,
            T_world_camera=slot.T_world_camera,
            board=self.published.document["board"],
            joints=self.robot.since(0),
            received_at_ns=now_ns,
            answered_at_ns=now_ns,
            contract_minor=CONTRACT_MINOR,
        )

    def update(self, update: UpdateRequest, ip: str, now_ns: int) -> UpdateAnswer:
        """Replace a unit's report by that of its newest frame.

        Raises:
            Refusal: 404 for an unknown id, 403 for another unit's id, 409 for an old session or sequence.
            WireError: keys or seen report are malformed; nothing was changed.
        """
        slot = self.registry.own(update.id, ip)
        if update.session != slot.session.number:
            raise Refusal(409, f"unit {slot.id}: its session has expired; initialize again")
        before = slot.session.sequence
        if update.sequence <= before:
            raise Refusal(409, f"unit {slot.id}: expected a sequence above {before}, got {update.sequence}")
        on_lattice = update.versions.lattice == self.versions.lattice
        keys = keys_from_bytes(update.keys, self.lattice.cell_count) if on_lattice else NO_KEYS
        if update.seen is not None and update.versions == self._versions_for(slot):
            self.coverage.report(slot.id, update.seen)
        self.map.replace(slot.id, keys)
        slot.session.store_update(update, now_ns)
        for ended in update.done:
            slot.end(ended.id, ended.outcome)
        self._notice(slot, now_ns)
        self._changed()
        return self._answer(slot, update, now_ns)

    def judge(self, slot: Slot, now_ns: int) -> tuple[State, Reason | None]:
        """Return a unit's state now, and the reason."""
        return slot.judge(now_ns, self.versions, self.settings)

    def tick(self, now_ns: int) -> None:
        """Notice changes by time alone: log each unit whose state changed, and end commands that were not answered.

        Answers do not depend on it: each is computed for its own `now_ns`.
        """
        for slot in self.registry:
            self._notice(slot, now_ns)

    def units(self, now_ns: int) -> list[UnitRow]:
        """Return one row for each unit."""
        rows = []
        for slot in self.registry:
            pose = slot.T_world_camera
            range_m = None if pose is None else self.coverage.range_m(slot.id, pose)
            voxels = len(self.map.keys_of(slot.id))
            range_m = None if range_m is None else round(range_m, 2)
            rows.append(slot.row(now_ns, *self.judge(slot, now_ns), voxels, range_m))
        return rows

    def unit_states(self, now_ns: int) -> list[UnitState]:
        """Return the part of each row that a stream sends at every change."""
        rows = []
        for slot in self.registry:
            state, cause = self.judge(slot, now_ns)
            age_s = slot.session.age_s(now_ns)
            voxels = len(self.map.keys_of(slot.id))
            age_s = None if age_s is None else round(age_s, 4)
            rows.append(UnitState(slot.id, slot.ip, state, sentence_of(cause), cause, age_s, voxels))
        return rows

    def forget(self, unit_id: int) -> None:
        """Delete a unit. If it still runs it comes back as a new one.

        Raises:
            Refusal: 404, the unit is unknown; 507, the change cannot be stored.
        """
        self.registry.remove(unit_id)
        self._withdraw(unit_id)
        self._changed()

    def set_pose(
        self,
        unit_id: int,
        T_world_camera: Matrix,
        origin: PoseOrigin,
        ip: str | None,
        quality: PoseQuality | None = None,
    ) -> int:
        """Set a camera's pose from any origin and return its version. `ip` is the caller's, if the caller is a unit.

        Raises:
            Refusal: 404, the unit is unknown; 403, the unit is not the caller's; 507, the pose cannot be stored.
            InputError: the pose is not a rigid transform.
        """
        slot = self.registry.get(unit_id) if ip is None else self.registry.own(unit_id, ip)
        pose = matrix_of(validated(T_world_camera, "T_world_camera"))
        self.registry.set_pose(slot, pose, origin, quality)
        self._withdraw(slot.id)
        self._changed()
        logger.info("unit %d (%s): its pose is set (%s)", slot.id, slot.ip, origin, extra=slot.log_fields("pose"))
        return slot.pose_version

    def send_command(self, unit_id: int, verb: Verb, now_ns: int) -> Command:
        """Send a command to a unit.

        Raises:
            Refusal: 404, the unit is unknown; 409, too many commands wait for it.
        """
        return self.registry.send_command(self.registry.get(unit_id), verb, now_ns)

    # ------------------------------------------------------------------ map and changes

    def view(self, now_ns: int) -> MapView:
        """Return the union of the live units' reports, and the reasons if it is incomplete (Algorithm 9)."""
        causes: list[Reason] = []
        live: list[int] = []
        oldest_s: float | None = None
        for slot in self.registry:
            state, cause = self.judge(slot, now_ns)
            if state != "live":
                assert cause is not None
                causes.append(_of_unit(slot, cause.code, f"is {state}: {cause.sentence}", cause.numbers))
                continue
            live.append(slot.id)
            age_s = slot.session.age_s(now_ns) or 0.0
            oldest_s = age_s if oldest_s is None else max(oldest_s, age_s)
            if not self.coverage.has(slot.id):
                causes.append(_of_unit(slot, "not_seen", "has not reported what it looks through"))
        if not len(self.registry):
            causes.append(Reason("no_unit", "there is no unit"))
        _, robot_cause = self.robot.state(now_ns, self.settings.robot_stale_after_s)
        if robot_cause is not None:
            causes.append(robot_cause)
        keys, witnesses = self.map.voxels(live)
        return MapView(
            self.lattice,
            self.versions.lattice,
            keys,
            witnesses,
            tuple(cause.sentence for cause in causes),
            oldest_s,
            len(live),
            self.map.reports(live),
            tuple(causes),
        )

    def seen_by(self, now_ns: int) -> NDArray[np.uint8]:
        """Return the number of live units that see each block, in the shape of `coverage.blocks`."""
        return self.coverage.seen_by(slot.id for slot in self.registry if self.judge(slot, now_ns)[0] == "live")

    def blocks_at(self, now_ns: int) -> Lattice:
        """Return the blocks of `seen_by`."""
        return self.coverage.blocks

    def next_change_ns(self, now_ns: int) -> int | None:
        """Return the first time at which a unit or the robot becomes stale without a new report; None without any."""
        moments = [slot.session.expires_at_ns(self.settings.stale_after_s) for slot in self.registry]
        moments.append(self.robot.expires_at_ns(self.settings.robot_stale_after_s))
        return min((moment for moment in moments if moment is not None and moment >= now_ns), default=None)

    # ------------------------------------------------------------------ robot

    def put_joints(self, request: JointsRequest, now_ns: int) -> None:
        """Store the robot's joints; raises as `RobotJoints.put`."""
        was_fresh = self.robot.state(now_ns, self.settings.robot_stale_after_s)[0] == "fresh"
        self.robot.put(request, now_ns)
        if not was_fresh:
            self._changed()

    def robot_answer(self, since_ns: int | None, now_ns: int) -> RobotAnswer:
        """Return the newest joints, or all after `since_ns`."""
        state, cause = self.robot.state(now_ns, self.settings.robot_stale_after_s)
        age_s = self.robot.age_s(now_ns)
        newest = self.robot.newest
        samples = self.robot.since(since_ns) if since_ns is not None else () if newest is None else (newest,)
        return RobotAnswer(
            state=state,
            reason=sentence_of(cause),
            joint_names=self.robot.joint_names or (),
            age_s=None if age_s is None else round(age_s, 4),
            now_ns=now_ns,
            joints=samples,
        )

    # ------------------------------------------------------------------ changes by an operator

    def change_settings(self, changes: Mapping[str, object]) -> Settings:
        """Change some settings; the others stay. Every unit receives them with the answer to its next update.

        Raises:
            Refusal: 422, a name is unknown or a value out of range; 507, the change cannot be stored.
            InputError: the cell would need too many voxels of that size; nothing is changed.
        """
        try:
            settings = Settings.model_validate({**self.settings.model_dump(), **changes})
        except ValidationError as error:
            raise Refusal(422, sentence(error)) from error
        if settings == self.settings:
            return settings
        lattice = self.cell.lattice(settings.voxel_size_m)
        blocks = self.cell.blocks(settings.seen_block_size_m)
        lattice_changes = lattice != self.lattice
        versions = Versions(
            settings=self.versions.settings + 1,
            lattice=self.versions.lattice + lattice_changes,
            cell=self.versions.cell,
        )
        self.store.save_settings(settings, versions)
        self.settings, self.versions = settings, versions
        if lattice_changes or blocks != self.coverage.blocks:
            self._begin_on(lattice, blocks)
        self._changed()
        return settings

    def change_cell(self, cell: Cell | PublishedCell) -> CellAnswer:
        """Watch another cell. Every unit learns of it with the answer to its next update. The unit is not live until it
        works with that cell.

        The robot's joints are kept if the robot is the same.

        Raises:
            InputError: the cell would need too many voxels; the old one stays.
            CellError: a mesh is far too large and does not touch the box; the old one stays.
            Refusal: 507, the cell cannot be stored; the old one stays.
        """
        published = cell if isinstance(cell, PublishedCell) else PublishedCell.of(cell)
        lattice = published.cell.lattice(self.settings.voxel_size_m)
        blocks = published.cell.blocks(self.settings.seen_block_size_m)
        if published.reference == self.published.reference:
            return self.cell_answer
        versions = self.versions.model_copy(
            update={
                "cell": self.versions.cell + 1,
                "lattice": self.versions.lattice + (lattice != self.lattice),
            }
        )
        self.store.save_cell(published.document, published.meshes, versions)
        if published.document["robot"] != self.published.document["robot"]:
            robot = published.cell.robot
            self.robot = RobotJoints(robot.joint_names if robot else None)
        self.published, self.versions = published, versions
        # All reports were made with the old cell.
        self._begin_on(lattice, blocks)
        logger.info("cell %s: version %d, %s", published.cell.name, self.versions.cell, published.reference.sha256[:8])
        self._changed()
        return self.cell_answer

    def move_object(self, name: str, T_world_object: Matrix) -> CellAnswer:
        """Set the pose of a known object; otherwise as `change_cell`.

        Raises:
            Refusal: 404, no object has this name; 507, the change cannot be stored.
            InputError: the pose is not a rigid transform.
        """
        names = [body.name for body in self.cell.objects]
        if name not in names:
            raise Refusal(404, f"object {name}: not in this cell; its objects are {', '.join(names) or 'none'}")
        return self.change_cell(self.published.with_object_pose(name, T_world_object))

    @property
    def cell_answer(self) -> CellAnswer:
        """Return the name and the version of the watched cell."""
        return CellAnswer(cell=self.published.reference, versions=self.versions)

    # ------------------------------------------------------------------ inside

    def _changed(self) -> None:
        for listener in self.listeners:
            listener()

    def _begin_on(self, lattice: Lattice, blocks: Lattice) -> None:
        """Start with another lattice and blocks; all reports are dropped."""
        self.lattice = lattice
        self.lattice_description = LatticeDescription.of(self.lattice)
        self.map = MergedMap(self.lattice)
        self.coverage = Coverage(blocks)

    def _withdraw(self, unit_id: int) -> None:
        self.map.withdraw(unit_id)
        self.coverage.withdraw(unit_id)

    def _notice(self, slot: Slot, now_ns: int) -> None:
        if slot.pending:
            slot.expire(now_ns)
        state, cause = self.judge(slot, now_ns)
        if state != slot.logged_state:
            slot.log_state(state, cause)

    def _answer(self, slot: Slot, update: UpdateRequest, now_ns: int) -> UpdateAnswer:
        current, theirs = self._versions_for(slot), update.versions
        answer = UpdateAnswer(
            versions=current,
            received_at_ns=now_ns,
            answered_at_ns=now_ns,
            joints=self.robot.since(update.joints_until_ns),
            commands=slot.commands,
        )
        if current == theirs:
            return answer
        changed: dict[str, object] = {}
        if current.settings != theirs.settings or current.lattice != theirs.lattice:
            changed |= {"settings": self.settings, "lattice": self.lattice_description}
        if current.cell != theirs.cell:
            changed["cell"] = self.published.reference
        if current.pose != theirs.pose:
            changed["T_world_camera"] = slot.T_world_camera
        return answer.model_copy(update=changed)

    def _versions_for(self, slot: Slot) -> Versions:
        ours = self.versions
        return Versions(settings=ours.settings, lattice=ours.lattice, cell=ours.cell, pose=slot.pose_version)


def _of_unit(slot: Slot, code: ReasonCode, what: str, numbers: Mapping[str, float] | None = None) -> Reason:
    """Return a reason that concerns one unit."""
    return Reason(code, f"unit {slot.id} ({slot.ip}) {what}", {"unit": float(slot.id), **(numbers or {})})
