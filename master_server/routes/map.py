# SPDX-License-Identifier: Apache-2.0
"""The merged map, and the settings that shape it."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

import msgpack
import numpy as np
from fastapi import APIRouter, Body, Query, Request, Response

from master_server.master import MapView, Master
from master_server.routes.common import OPERATOR_ONLY, READERS, MasterDependency, Negotiated, wants_msgpack
from shared.clock import monotonic_ns
from shared.messages import LatticeDescription, VoxelsAnswer
from shared.settings import Settings
from shared.wire import MEDIA_TYPE

router = APIRouter(tags=["map"], route_class=Negotiated)

Form = Literal["indices", "centres", "keys"]

CENTRE_DECIMALS = 4
"""Centres to a tenth of a millimetre, a hundredth of the smallest voxel."""


@router.get("/voxels", dependencies=READERS, response_model=VoxelsAnswer)
async def voxels(
    request: Request,
    master: MasterDependency,
    form: Annotated[Form, Query(description="Indices (N, 3), centres (N, 3) in m, or keys (N,).")] = "indices",
    unseen: Annotated[bool, Query(description="Also the blocks that no live unit looks through.")] = False,
) -> Response:
    """All obstacle voxels, each with the number of units that report it, and whether that is all there is."""
    now_ns = monotonic_ns()
    view = master.view(now_ns)
    answer = {
        "lattice": LatticeDescription.of(view.lattice).model_dump(),
        "lattice_version": view.lattice_version,
        "voxels": _voxels(view, form),
        "witnesses": view.witnesses.tolist(),
        "complete": view.complete,
        "reasons": list(view.reasons),
        "oldest_view_age_s": None if view.oldest_view_age_s is None else round(view.oldest_view_age_s, 4),
        "units_live": view.units_live,
        "now_ns": now_ns,
        "unseen": _unseen(master, now_ns) if unseen else None,
    }
    # Neither validated nor encoded by the framework, which takes ten times as long for a thousand voxels.
    if wants_msgpack(request):
        return Response(msgpack.packb(answer), media_type=MEDIA_TYPE)
    return Response(json.dumps(answer, separators=(",", ":")), media_type="application/json")


@router.get("/settings", dependencies=READERS)
async def settings(master: MasterDependency) -> Settings:
    """What an operator may change while everything runs."""
    return master.settings


@router.put("/settings", dependencies=OPERATOR_ONLY)
async def change_settings(
    master: MasterDependency,
    changes: Annotated[dict[str, Any], Body(examples=[{"voxel_size_m": 0.03}, {"stale_after_s": 0.4}])],
) -> Settings:
    """Change some of them; the others stay. Every unit has them with the answer to its next update."""
    return master.change_settings(changes)


def _voxels(view: MapView, form: Form) -> list[Any]:
    if form == "keys":
        return list(view.keys.tolist())
    indices = view.lattice.indices(view.keys)
    if form == "indices":
        return list(indices.tolist())
    return list(np.round(view.lattice.centres(indices), CENTRE_DECIMALS).tolist())


def _unseen(master: Master, now_ns: int) -> dict[str, Any]:
    blocks = master.coverage.blocks
    seen_by = master.seen_by(now_ns)
    return {**LatticeDescription.of(blocks).model_dump(), "blocks": np.argwhere(seen_by == 0).tolist()}
