# SPDX-License-Identifier: Apache-2.0
"""The master's assignment of a unit, and the unit's report of a frame, as values."""

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
    """The master's assignment of this unit: all that a frame is processed with."""

    session: int
    versions: Versions
    settings: Settings
    lattice: Lattice
    cell: Cell
    T_world_camera: Transform | None

    @property
    def phase(self) -> Phase:
        """Phase of a unit with this assignment."""
        return "localising" if self.T_world_camera is None else "live"


class LatestAssignment:
    """The only owner of the assignment: the master's latest, None while the unit is not registered."""

    def __init__(self) -> None:
        self.value: Assignment | None = None
        self.there = asyncio.Event()

    def set(self, assignment: Assignment) -> None:
        """Use `assignment` from the next frame on."""
        self.value = assignment
        self.there.set()

    def clear(self) -> None:
        """Remove the assignment until the unit has registered again."""
        self.value = None
        self.there.clear()


class Trouble(NamedTuple):
    """The reason why a unit reports no voxels: a code, a sentence, and the progress of the task that ends it."""

    code: TroubleCode
    sentence: str
    progress: Progress | None = None

    def facts(self) -> dict[str, Any]:
        """Return the fields of `Health` for this trouble; a sentence that is too long is cut."""
        return {"trouble": self.sentence[:MAX_TEXT], "trouble_code": self.code, "progress": self.progress}


@dataclass(frozen=True, eq=False)
class Report:
    """The result of one frame, with the assignment that it was made with. `seen` is None if nothing is known of it.

    `stages_ns` has the duration of each stage, for a frame that went through all of them.
    """

    assignment: Assignment
    captured_at_ns: int | None = None
    keys: bytes = b""
    seen: SeenBlocks | None = None
    health: Health = field(default_factory=Health)
    stages_ns: dict[str, int] = field(default_factory=dict)


class Delivery(NamedTuple):
    """Times at which a report was sent, received and merged, by the unit's clock, ns."""

    sent_at_ns: int
    received_at_ns: int
    merged_at_ns: int


def seen_report(seen: SeenBlocks) -> SeenReport:
    """Return the blocks as a report; with larger blocks if it would be too long."""
    while True:
        nx, ny, nz = seen.lattice.shape
        report = pack_seen(seen.seen.reshape(nx, ny, nz), seen.lattice.voxel_size_m)
        if report is not None:
            return report
        seen = seen.coarser()
