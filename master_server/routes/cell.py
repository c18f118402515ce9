# SPDX-License-Identifier: Apache-2.0
"""The cell's document and meshes, which a unit keeps by their hashes."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Response

from master_server.routes.common import READERS, MasterDependency, Negotiated
from shared.errors import Refusal

router = APIRouter(tags=["cell"], route_class=Negotiated)

Sha256 = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$", description="Of the mesh, as the cell's document has it.")]


@router.get("/cell", dependencies=READERS)
async def cell(master: MasterDependency, response: Response) -> dict[str, Any]:
    """The cell as a document that names its meshes by sha256; the ETag is the sha256 of the document."""
    response.headers["ETag"] = f'"{master.cell_reference.sha256}"'
    return master.cell_document


@router.get("/cell/meshes/{sha256}", dependencies=READERS, response_class=Response)
async def mesh(sha256: Sha256, master: MasterDependency) -> Response:
    """A mesh in its canonical bytes; it never changes, so keep it for ever."""
    data = master.meshes.get(sha256)
    if data is None:
        raise Refusal(404, f"mesh {sha256}: it is not part of the current cell")
    return Response(
        data,
        media_type="application/octet-stream",
        headers={"Cache-Control": "public, max-age=31536000, immutable", "ETag": f'"{sha256}"'},
    )
