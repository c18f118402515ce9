# SPDX-License-Identifier: Apache-2.0
"""The robot's joints."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from master_server.api.routes.common import (
    OPERATOR_ONLY,
    READERS,
    MasterDependency,
    Negotiated,
    ReadableDependency,
    wants_msgpack,
)
from shared.clock import monotonic_ns
from shared.messages import JointsRequest, RobotAnswer
from shared.wire import MEDIA_TYPE, encode

router = APIRouter(tags=["robot"], route_class=Negotiated)


@router.put("/robot/joints", dependencies=OPERATOR_ONLY, status_code=204)
async def put_joints(body: JointsRequest, master: MasterDependency) -> None:
    """Store the robot's joints; send them often: 125 times a second is good."""
    master.put_joints(body, monotonic_ns())


@router.get("/robot", dependencies=READERS, response_model=RobotAnswer)
async def robot(
    request: Request,
    master: ReadableDependency,
    since_ns: Annotated[
        int | None, Query(ge=0, lt=2**63, description="All samples after this time, not only the newest.")
    ] = None,
) -> Response:
    """Return the robot's state, and its joints by the master's clock, whose present time is `now_ns`."""
    answer = master.robot_answer(since_ns, monotonic_ns())
    # Units poll this before every frame, so encode msgpack directly, without JSON.
    if wants_msgpack(request):
        return Response(encode(answer), media_type=MEDIA_TYPE)
    return Response(answer.model_dump_json(), media_type="application/json")
