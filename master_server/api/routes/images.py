# SPDX-License-Identifier: Apache-2.0
"""A unit's images, on request: without a request, none is sent or stored."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response

from master_server.api.routes.common import READERS, UNIT_ONLY, MasterServicesDependency, body_of, ip_of
from shared.clock import monotonic_ns
from shared.messages import MAX_IMAGE_BYTES, PICTURE_RANGE_M, ImageKind

router = APIRouter(tags=["units"])

UnitId = Annotated[int, Path(ge=0, lt=2**31, description="Id in `GET /units`.")]

PNG = "image/png"


@router.get(
    "/units/{unit_id}/images/{kind}",
    dependencies=READERS,
    response_class=Response,
    responses={200: {"content": {PNG: {"schema": {"type": "string", "format": "binary"}}}}},
)
async def image(
    unit_id: UnitId,
    kind: ImageKind,
    services: MasterServicesDependency,
    raw: Annotated[bool, Query(description="16 bits in units of depth_scale instead of colours.")] = False,
) -> Response:
    """Return an image (PNG) of the unit's next frame: measured depth, expected depth, or the remaining foreground.

    In colours, near is red and far is blue, over the metres in the header `X-Depth-Range-M`; black is no value.
    """
    png = await services.image_requests.get(unit_id, kind, raw, monotonic_ns())
    headers = {"Cache-Control": "no-store"}
    if not raw:
        headers["X-Depth-Range-M"] = "{:g} {:g}".format(*PICTURE_RANGE_M)
    return Response(png, media_type=PNG, headers=headers)


@router.put(
    "/units/{unit_id}/images/{kind}",
    dependencies=UNIT_ONLY,
    status_code=204,
    openapi_extra={
        "requestBody": {"required": True, "content": {PNG: {"schema": {"type": "string", "format": "binary"}}}}
    },
)
async def put_image(
    unit_id: UnitId,
    kind: ImageKind,
    request: Request,
    services: MasterServicesDependency,
    command: Annotated[int, Query(ge=0, lt=2**63, description="Id of the command that it answers.")],
) -> None:
    """Accept the image that a unit was commanded to send; each unit sends only its own."""
    services.master.registry.own(unit_id, ip_of(request.scope))
    requests = services.image_requests
    requests.check_pending(unit_id, command)
    requests.deliver(unit_id, command, await body_of(request, MAX_IMAGE_BYTES))
