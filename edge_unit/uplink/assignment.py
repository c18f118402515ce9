# SPDX-License-Identifier: Apache-2.0
"""The master's assignment to a unit, and the unit's report of a frame, as values."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from edge_unit.pipeline import SeenBlocks
from shared.cell import Cell
from shared.lattice import Lattice
from shared.messages import MAX_TEXT, Health, Phase, Progress, SeenReport, TroubleCode, Versions
from shared.settings import Settings
from shared.transforms import Transform
from shared.wire import pack_seen


@dataclass(frozen=True, eq=False)
class Assignment:
    """The master's assignment to this unit: all inputs of frame processing that the master sets."""

    session: int
    versions: Versions
    settings: Settings
    lattice: Lattice
    cell: Cell
    T_world_camera: Transform | None

    @property
    def phase(self) -> Phase:
        """Return the phase of a unit with this assignment."""
        return "localising" if self.T_world_camera is None else "live"


class LatestAssignment:
    """The only owner of the assignment: the master's latest one, or None while the unit is not registered."""

    def __init__(self) -> None:
        self.value: Assignment | None = None
        self.available = asyncio.Event()

    def set(self, assignment: Assignment) -> None:
        """Use `assignment` from the next frame on."""
        self.value = assignment
        self.available.set()

    def clear(self) -> None:
        """Remove the assignment until the unit has registered again."""
        self.value = None
        self.available.clear()


class Trouble(NamedTuple):
    """The reason why a unit reports no voxels: a code, a sentence, and the progress of a task that removes it."""

    code: TroubleCode
    sentence: str
    progress: Progress | None = None

    def facts(self) -> dict[str, Any]:
        """Return the trouble as fields of `Health`. A sentence longer than `MAX_TEXT` is cut."""
        return {"trouble": self.sentence[:MAX_TEXT], "trouble_code": self.code, "progress": self.progress}


@dataclass(frozen=True, eq=False)
class Report:
    """The result of one frame, and the assignment that the frame was processed with.

    `seen` is None when the unit does not know which space it has seen. `stages_ns` has the duration of each stage if
    the frame passed all stages.
    """

    assignment: Assignment
    captured_at_ns: int | None = None
    keys: bytes = b""
    seen: SeenBlocks | None = None
    health: Health = field(default_factory=Health)
    stages_ns: dict[str, int] = field(default_factory=dict)


class Delivery(NamedTuple):
    """The times of a report, in ns of the unit's clock: sent, received whole by the master, merged by the master."""

    sent_at_ns: int
    received_at_ns: int
    merged_at_ns: int


def seen_report(seen: SeenBlocks) -> SeenReport:
    """Return the blocks as a report, in larger blocks if the report would be too long."""
    while True:
        nx, ny, nz = seen.lattice.shape
        report = pack_seen(seen.seen.reshape(nx, ny, nz), seen.lattice.voxel_size_m)
        if report is not None:
            return report
        seen = seen.coarser()
