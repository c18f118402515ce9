# SPDX-License-Identifier: Apache-2.0
"""What one look at the master tells: as little work for the master as may be, arrays as they lie in memory."""

from __future__ import annotations

from typing import Any

import numpy as np

from master_server.readable import Readable
from master_server.replay import Replay
from shared.lattice import Lattice
from shared.messages import LatticeDescription

REASONS_MAX = 8
"""Why the map is not complete: what fits beside it; one for each of 64 units does not."""


def look(master: Readable, with_units: bool, with_unseen: bool, now_ns: int) -> dict[str, Any]:
    """The map and the robot as plain values; units, and what nobody sees, only where asked for."""
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
    if with_units:
        told["units"] = [row.model_dump() for row in master.units(now_ns)]
    if with_unseen:
        seen = master.seen_by(now_ns) > 0
        told["seen"] = np.packbits(seen).tobytes()
        told["blocks"] = _described(master.blocks_at(now_ns))
    if isinstance(master, Replay):
        told["replay"] = master.answer(now_ns).model_dump()
    return told


def _described(lattice: Lattice) -> dict[str, Any]:
    return LatticeDescription.of(lattice).model_dump()
