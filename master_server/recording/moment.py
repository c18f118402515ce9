# SPDX-License-Identifier: Apache-2.0
"""The records of a recording, besides the channels that are drawn: all that the master answered, without loss.

A recording is an MCAP file. Its own channels are JSON with a JSON schema; arrays are bytes in base64:

    /cellwatch/state      `StateRecord`   ten times a second: ages, states and reasons
    /cellwatch/map        `MapRecord`     when it changed
    /cellwatch/seen       `SeenRecord`    when it changed
    /cellwatch/settings   `Settings`      when they changed

The latter three are written at the beginning of each chunk as well, so that every chunk can be read by itself.
Cells and meshes are attachments, named by their sha256. Log times are nanoseconds since 1970.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from master_server.core import MapView, Master
from shared.cell import Cell
from shared.errors import InputError
from shared.lattice import Lattice
from shared.messages import (
    OPEN,
    CellReference,
    Counter,
    LatticeDescription,
    Nanoseconds,
    Reason,
    RobotAnswer,
    RobotState,
    UnitRow,
)
from shared.settings import Settings

FORMAT_MAJOR, FORMAT_MINOR = 1, 1
"""Version of a recording. The major rises when older recordings can no longer be played; the minor when a status gets
new names or codes, which an older reader ignores. Recordings of 1.0 say `1`."""

METADATA = "cellwatch"
"""Name of the metadata record that holds the format."""

STATE_TOPIC = "/cellwatch/state"
MAP_TOPIC = "/cellwatch/map"
SEEN_TOPIC = "/cellwatch/seen"
SETTINGS_TOPIC = "/cellwatch/settings"


def cell_attachment(sha256: str) -> str:
    """Return the name of the attachment with a cell's document."""
    return f"cells/{sha256}"


def mesh_attachment(sha256: str) -> str:
    """Return the name of the attachment with a mesh in its canonical bytes."""
    return f"meshes/{sha256}"


class Moment(NamedTuple):
    """The master's state at `at_ns` of its clock. Immutable."""

    at_ns: int
    view: MapView
    blocks: Lattice
    seen_by: NDArray[np.uint8]
    units: tuple[UnitRow, ...]
    robot: RobotAnswer
    settings: Settings
    cell: Cell
    reference: CellReference


def moment_of(master: Master, now_ns: int) -> Moment:
    """Return the master's state at `now_ns`."""
    return Moment(
        now_ns,
        master.view(now_ns),
        master.coverage.blocks,
        master.seen_by(now_ns),
        tuple(master.units(now_ns)),
        master.robot_answer(0, now_ns),
        master.settings,
        master.cell,
        master.published.reference,
    )


class Record(BaseModel):
    """One message of a recording. Frozen; names of a later minor are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", ser_json_bytes="base64", val_json_bytes="base64")


class RecordedRobot(RobotAnswer):
    """The robot's state in a recording: unknown names are ignored, an unknown state kept."""

    model_config = ConfigDict(extra="ignore")

    state: Annotated[RobotState, OPEN]


def _recorded_robot(robot: object) -> object:
    if not isinstance(robot, dict):
        return robot
    try:
        return RobotAnswer.model_validate(robot)
    except ValidationError:
        return RecordedRobot.model_validate(robot)


class StateRecord(Record):
    """Ages, states and reasons, which change with time alone. `at_ns` is by the master's clock.

    `causes` are the reasons for programs; older recordings have none.
    """

    at_ns: Nanoseconds
    complete: bool
    reasons: tuple[str, ...]
    oldest_view_age_s: float | None
    units_live: int
    voxels: int
    units: tuple[UnitRow, ...]
    robot: Annotated[RobotAnswer, BeforeValidator(_recorded_robot)]
    cell: CellReference
    causes: tuple[Reason, ...] = ()

    @classmethod
    def of(cls, moment: Moment) -> StateRecord:
        """Make the record of a moment."""
        view = moment.view
        return cls(
            at_ns=moment.at_ns,
            complete=view.complete,
            reasons=view.reasons,
            oldest_view_age_s=view.oldest_view_age_s,
            units_live=view.units_live,
            voxels=len(view.keys),
            units=moment.units,
            robot=moment.robot,
            cell=moment.reference,
            causes=view.causes,
        )


class MapRecord(Record):
    """The merged map: `keys` little-endian uint32, ascending; `witnesses` uint8, one each.

    `reports` are the keys of each live unit by its id; older recordings have none.
    """

    lattice: LatticeDescription
    lattice_version: Counter
    keys: bytes
    witnesses: bytes
    reports: dict[int, bytes] = {}

    @classmethod
    def of(cls, view: MapView) -> MapRecord:
        """Make the record of a map."""
        return cls(
            lattice=LatticeDescription.of(view.lattice),
            lattice_version=view.lattice_version,
            keys=view.keys.astype("<u4", copy=False).tobytes(),
            witnesses=view.witnesses.tobytes(),
            reports={unit_id: keys.astype("<u4", copy=False).tobytes() for unit_id, keys in view.reports.items()},
        )

    def arrays(self) -> tuple[NDArray[np.uint32], NDArray[np.uint8]]:
        """Return keys (N,) and witnesses (N,).

        Raises:
            InputError: their numbers differ.
        """
        if len(self.keys) != 4 * len(self.witnesses):
            raise InputError(f"map: expected 4 bytes a witness, got {len(self.keys)} and {len(self.witnesses)}")
        return np.frombuffer(self.keys, "<u4"), np.frombuffer(self.witnesses, np.uint8)

    def reported(self) -> dict[int, NDArray[np.uint32]]:
        """Return the keys (N,) of each unit.

        Raises:
            InputError: the bytes of a unit are not a whole number of keys.
        """
        for unit_id, keys in self.reports.items():
            if len(keys) % 4:
                raise InputError(f"map: expected 4 bytes a voxel of unit {unit_id}, got {len(keys)}")
        return {unit_id: np.frombuffer(keys, "<u4") for unit_id, keys in self.reports.items()}


class SeenRecord(Record):
    """Number of live units that looked through each block: uint8 in C order."""

    blocks: LatticeDescription
    seen_by: bytes

    @classmethod
    def of(cls, moment: Moment) -> SeenRecord:
        """Make the record of the seen blocks at a moment."""
        return cls(blocks=LatticeDescription.of(moment.blocks), seen_by=moment.seen_by.tobytes())

    def counts(self) -> NDArray[np.uint8]:
        """Return the counts in the shape of the blocks.

        Raises:
            InputError: there are more or fewer counts than blocks.
        """
        counts = np.frombuffer(self.seen_by, np.uint8)
        if counts.size != np.prod(self.blocks.shape):
            raise InputError(f"seen: expected one count a block of {self.blocks.shape}, got {counts.size}")
        return counts.reshape(self.blocks.shape)
