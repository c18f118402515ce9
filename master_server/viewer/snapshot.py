# SPDX-License-Identifier: Apache-2.0
"""The master's state for one refresh of the viewer: with little work for the master, arrays as they are in memory."""

from __future__ import annotations

import numpy as np

from master_server.api.history import History
from master_server.core import Readable
from master_server.recording.replay import Replay
from master_server.viewer.messages import MapBits, RobotStatus, SeenBits, StateRequest, ViewerState
from shared.messages import LatticeDescription

REASONS_MAX = 8
"""Reasons in the panel: as many as fit beside the map; one for each of 64 units would not."""


def viewer_state(master: Readable, history: History, wanted: StateRequest, now_ns: int) -> ViewerState:
    """Return the map and the robot, and the requested parts.

    Raises:
        Refusal: 500, a recording is damaged here.
    """
    view = master.view(now_ns)
    robot = master.robot_answer(None, now_ns)
    seen = None
    if wanted.unseen:
        bits = np.packbits(master.seen_by(now_ns) > 0).tobytes()
        seen = SeenBits(bits=bits, blocks=LatticeDescription.of(master.blocks_at(now_ns)))
    return ViewerState(
        now_ns=now_ns,
        cell=master.published.reference.sha256,
        map=MapBits(
            lattice=LatticeDescription.of(view.lattice),
            keys=view.keys.tobytes(),
            witnesses=view.witnesses.tobytes(),
            reports={unit_id: keys.tobytes() for unit_id, keys in view.reports.items()} if wanted.reports else None,
        ),
        reasons=view.reasons[:REASONS_MAX],
        reason_count=len(view.reasons),
        oldest_view_age_s=view.oldest_view_age_s,
        units_live=view.units_live,
        robot=RobotStatus(state=robot.state, reason=robot.reason),
        joints=robot.joints[-1].positions if robot.joints else None,
        units=tuple(master.units(now_ns)) if wanted.units else None,
        history=tuple(history.since(wanted.since_ns)) if wanted.units else (),
        seen=seen,
        replay=master.answer(now_ns) if isinstance(master, Replay) else None,
    )
