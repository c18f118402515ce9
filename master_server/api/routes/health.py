# SPDX-License-Identifier: Apache-2.0
"""Liveness for service managers and load balancers, without a token; and the metrics."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, Field

from master_server.api.metrics import VERSION
from master_server.api.routes.common import READERS, MasterServicesDependency
from shared.clock import NS_PER_S, monotonic_ns

router = APIRouter(tags=["health"])


class HealthAnswer(BaseModel):
    """`GET /healthz`: only fields that everyone on the network may know."""

    status: Literal["ok"]
    version: str
    uptime_s: float
    units: int = Field(description="Number of slots.")
    live: int = Field(description="Number of live units.")
    storage: str = Field(description="`ok`, or a sentence if the last change could not be stored.")


@router.get("/healthz")
async def healthz(services: MasterServicesDependency) -> HealthAnswer:
    """Answer while the event loop runs; `GET /voxels` has the completeness of the map."""
    master, now_ns = services.master, monotonic_ns()
    return HealthAnswer(
        status="ok",
        version=VERSION,
        uptime_s=round((now_ns - services.started_at_ns) / NS_PER_S, 1),
        units=len(master.registry),
        live=sum(master.judge(slot, now_ns)[0] == "live" for slot in master.registry),
        storage="ok" if master.store.trouble is None else "the last change could not be stored",
    )


@router.get(
    "/metrics",
    dependencies=READERS,
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def metrics(services: MasterServicesDependency) -> Response:
    """Return all series of the master, as Prometheus text."""
    return Response(services.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)
