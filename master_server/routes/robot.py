# SPDX-License-Identifier: Apache-2.0
"""The robot's joints."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from master_server.routes.common import OPERATOR_ONLY, READERS, MasterDependency, Negotiated
from shared.clock import monotonic_ns
from shared.messages import JointsRequest, RobotAnswer

router = APIRouter(tags=["robot"], route_class=Negotiated)


@router.put("/robot/joints", dependencies=OPERATOR_ONLY, status_code=204)
async def put_joints(body: JointsRequest, master: MasterDependency) -> None:
    """Where the robot is; the more often the better, 125 times a second is good."""
    master.put_joints(body, monotonic_ns())


@router.get("/robot", dependencies=READERS)
async def robot(
    master: MasterDependency,
    since_ns: Annotated[
        int | None, Query(ge=0, lt=2**63, description="All samples after this time, not only the newest.")
    ] = None,
) -> RobotAnswer:
    """Whether the robot reports, and its joints by the master's clock, of which `now_ns` is now."""
    return master.robot_answer(since_ns, monotonic_ns())
