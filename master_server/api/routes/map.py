# SPDX-License-Identifier: Apache-2.0
"""The merged map, the coverage, the history of both, and the settings."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Body, Query, Request, Response

from master_server.api.history import HistoryAnswer
from master_server.api.responses import (
    CoverageAnswer,
    Form,
    as_json,
    as_msgpack,
    coverage_fields,
    map_fields,
    unseen_fields,
)
from master_server.api.routes.common import (
    OPERATOR_ONLY,
    READERS,
    MasterDependency,
    Negotiated,
    ReadableDependency,
    ServicesDependency,
    wants_msgpack,
)
from shared.clock import monotonic_ns
from shared.messages import VoxelsAnswer
from shared.settings import Settings
from shared.wire import MEDIA_TYPE

router = APIRouter(tags=["map"], route_class=Negotiated)


@router.get("/voxels", dependencies=READERS, response_model=VoxelsAnswer)
async def voxels(
    request: Request,
    master: ReadableDependency,
    form: Annotated[Form, Query(description="Indices (N, 3), centres (N, 3) in m, or keys (N,).")] = "indices",
    unseen: Annotated[bool, Query(description="Also return the blocks that no live unit sees.")] = False,
) -> Response:
    """Return all obstacle voxels, each with the number of units that report it, and the completeness of the map."""
    now_ns = monotonic_ns()
    unseen_blocks = unseen_fields(master.blocks_at(now_ns), master.seen_by(now_ns)) if unseen else None
    return _packed(request, map_fields(master.view(now_ns), form, unseen_blocks, now_ns))


@router.get("/coverage", dependencies=READERS, response_model=CoverageAnswer)
async def coverage(
    request: Request,
    master: ReadableDependency,
    blocks: Annotated[bool, Query(description="Also return the number of units that see each block, as runs.")] = False,
) -> Response:
    """Return the share of the cell that live units see now; all other blocks are unseen, not free."""
    return _packed(request, coverage_fields(master, blocks, monotonic_ns()))


@router.get("/history", dependencies=READERS)
async def history(services: ServicesDependency) -> HistoryAnswer:
    """Return the last five minutes, one sample a second: the scene refresh time, voxels, live units."""
    return services.history.answer(monotonic_ns())


@router.get("/settings", dependencies=READERS)
async def settings(master: ReadableDependency) -> Settings:
    """Return the settings that an operator may change at run time."""
    return master.settings


@router.put("/settings", dependencies=OPERATOR_ONLY)
async def change_settings(
    master: MasterDependency,
    changes: Annotated[dict[str, Any], Body(examples=[{"voxel_size_m": 0.03}, {"stale_after_s": 0.4}])],
) -> Settings:
    """Change some settings; the others stay. Every unit receives them with the answer to its next update."""
    return master.change_settings(changes)


def _packed(request: Request, fields: dict[str, Any]) -> Response:
    if wants_msgpack(request):
        return Response(as_msgpack(fields), media_type=MEDIA_TYPE)
    return Response(as_json(fields), media_type="application/json")
