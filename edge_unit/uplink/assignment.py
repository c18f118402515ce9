# SPDX-License-Identifier: Apache-2.0
"""What the master wants of a unit, and what the unit reports of a frame, as values."""

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
    """What the master wants of this unit: all that a frame is processed with."""

    session: int
    versions: Versions
    settings: Settings
    lattice: Lattice
    cell: Cell
    T_world_camera: Transform | None

    @property
    def phase(self) -> Phase:
        """How far a unit with this assignment has come."""
        return "localising" if self.T_world_camera is None else "live"


class LatestAssignment:
    """The one owner of the assignment: the master's latest, None while the unit is not registered."""

    def __init__(self) -> None:
        self.value: Assignment | None = None
        self.available = asyncio.Event()

    def set(self, assignment: Assignment) -> None:
        """Work with `assignment` from the next frame on."""
        self.value = assignment
        self.available.set()

    def clear(self) -> None:
        """Have none until the unit has registered again."""
        self.value = None
        self.available.clear()


class Trouble(NamedTuple):
    """Why a unit reports no voxels: a code, a sentence, and how far it is with what is to be waited for."""

    code: TroubleCode
    sentence: str
    progress: Progress | None = None

    def facts(self) -> dict[str, Any]:
        """The fields of `Health` that tell it; a sentence that is too long is cut."""
        return {"trouble": self.sentence[:MAX_TEXT], "trouble_code": self.code, "progress": self.progress}


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


class Delivery(NamedTuple):
    """When a report was sent, when the master had all of it, and when it had merged it: by the unit's clock, in ns."""

    sent_at_ns: int
    received_at_ns: int
    merged_at_ns: int


def seen_report(seen: SeenBlocks) -> SeenReport:
    """Return the blocks as a report, in larger ones where it would be too long."""
    while True:
        nx, ny, nz = seen.lattice.shape
        report = pack_seen(seen.seen.reshape(nx, ny, nz), seen.lattice.voxel_size_m)
        if report is not None:
            return report
        seen = seen.coarser()
