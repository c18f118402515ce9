# SPDX-License-Identifier: Apache-2.0
"""What one look at the master tells: as little work for the master as may be, arrays as they lie in memory."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from master_server.api.history import History
from master_server.core import Readable
from master_server.recording.replay import Replay
from shared.lattice import Lattice
from shared.messages import LatticeDescription

REASONS_MAX = 8
"""Why the map is not complete: what fits beside it; one for each of 64 units does not."""


class Wanted(NamedTuple):
    """What is asked for besides the map and the robot: it costs the master time or changes rarely.

    Attributes:
        units: their rows, and how things stood after `since_ns`.
        unseen: what nobody sees.
        reports: which unit reports which voxels.
        since_ns: the newest sample of the history that is known.
    """

    units: bool = False
    unseen: bool = False
    reports: bool = False
    since_ns: int = -1


def look(master: Readable, history: History, wanted: Wanted, now_ns: int) -> dict[str, Any]:
    """The map and the robot as plain values, and what else is wanted."""
    view = master.view(now_ns)
    robot = master.robot_answer(None, now_ns)
    told: dict[str, Any] = {
        "cell": master.published.reference.sha256,
        "lattice": _described(view.lattice),
        "keys": view.keys.tobytes(),
        "witnesses": view.witnesses.tobytes(),
        "reasons": view.reasons[:REASONS_MAX],
        "reason_count": len(view.reasons),
        "oldest_view_age_s": view.oldest_view_age_s,
        "units_live": view.units_live,
        "robot": {"state": robot.state, "reason": robot.reason},
        "joints": robot.joints[-1].positions if robot.joints else None,
    }
    if wanted.units:
        told["units"] = [row.model_dump() for row in master.units(now_ns)]
        told["now_ns"], told["history"] = now_ns, history.since(wanted.since_ns)
    if wanted.reports:
        told["reports"] = {unit_id: keys.tobytes() for unit_id, keys in view.reports.items()}
    if wanted.unseen:
        seen = master.seen_by(now_ns) > 0
        told["seen"] = np.packbits(seen).tobytes()
        told["blocks"] = _described(master.blocks_at(now_ns))
    if isinstance(master, Replay):
        told["replay"] = master.answer(now_ns).model_dump()
    return told


def _described(lattice: Lattice) -> dict[str, Any]:
    return LatticeDescription.of(lattice).model_dump()
