# SPDX-License-Identifier: Apache-2.0
"""Registration, and the state of each unit."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request, Response

from master_server.api.routes.common import (
    OPERATOR_ONLY,
    READERS,
    UNIT_ONLY,
    MasterDependency,
    Negotiated,
    ReadableDependency,
    bearer,
    ip_of,
    is_known,
)
from master_server.security import Role
from shared.clock import monotonic_ns
from shared.messages import Command, InitializeAnswer, InitializeRequest, PoseAnswer, PoseRequest, UnitRow

router = APIRouter(tags=["units"], route_class=Negotiated)

UnitId = Annotated[int, Path(ge=0, lt=2**31, description="Id in `GET /units`.")]


@router.post("/initialize", dependencies=UNIT_ONLY, response_model=InitializeAnswer)
async def initialize(body: InitializeRequest, request: Request, master: MasterDependency) -> Response:
    """Give a unit its slot; the same IP keeps the same id."""
    answer = master.initialize(body, ip_of(request.scope), monotonic_ns())
    # A unit of contract 5.0 refuses a name that it does not know.
    unknown = set() if body.contract_minor else {"contract_minor"}
    return Response(answer.model_dump_json(exclude=unknown), media_type="application/json")


@router.get("/units", dependencies=READERS)
async def units(master: ReadableDependency) -> list[UnitRow]:
    """Return one row for each unit."""
    return master.units(monotonic_ns())


@router.delete("/units/{unit_id}", dependencies=OPERATOR_ONLY, status_code=204)
async def forget(unit_id: UnitId, master: MasterDependency) -> None:
    """Delete a unit that is gone; one that still runs comes back as a new one."""
    master.forget(unit_id)


@router.put("/units/{unit_id}/pose", dependencies=[bearer])
async def set_pose(
    unit_id: UnitId,
    body: PoseRequest,
    request: Request,
    master: MasterDependency,
    role: Annotated[Role, Depends(is_known)],
) -> PoseAnswer:
    """Set the camera's pose; a unit may set only its own."""
    ip = ip_of(request.scope) if role is Role.UNIT else None
    return PoseAnswer(pose=master.set_pose(unit_id, body.T_world_camera, body.origin, ip, body.quality))


@router.post("/units/{unit_id}/background", dependencies=OPERATOR_ONLY, status_code=202)
async def learn_background(unit_id: UnitId, master: MasterDependency) -> Command:
    """Command a unit to learn the background of the empty cell. Nobody may be in it. `GET /units` has the outcome."""
    return master.send_command(unit_id, "learn_background", monotonic_ns())


@router.delete("/units/{unit_id}/background", dependencies=OPERATOR_ONLY, status_code=202)
async def drop_background(unit_id: UnitId, master: MasterDependency) -> Command:
    """Command a unit to drop its background model."""
    return master.send_command(unit_id, "drop_background", monotonic_ns())


@router.post("/units/{unit_id}/calibrate", dependencies=OPERATOR_ONLY, status_code=202)
async def calibrate(unit_id: UnitId, master: MasterDependency) -> Command:
    """Command a unit to search for the calibration board again. `GET /units` has the outcome."""
    return master.send_command(unit_id, "calibrate", monotonic_ns())


@router.post("/units/{unit_id}/refine", dependencies=OPERATOR_ONLY, status_code=202)
async def refine(unit_id: UnitId, master: MasterDependency) -> Command:
    """Command a unit to refine its camera's pose against the CAD that it sees. `GET /units` has the outcome."""
    return master.send_command(unit_id, "refine", monotonic_ns())
