# SPDX-License-Identifier: Apache-2.0
"""The cell: its document and meshes, which a unit caches by their hashes, and changes by an operator."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path as FilePath
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response

from master_server.api.routes.common import (
    OPERATOR_ONLY,
    READERS,
    MasterDependency,
    MasterServicesDependency,
    Negotiated,
    ReadableDependency,
    body_of,
    pour,
)
from master_server.cells.cell_loading import MAX_ZIP_BYTES, CellLoader
from master_server.cells.published import PublishedCell
from shared.errors import Refusal
from shared.messages import CellAnswer, ObjectPoseRequest
from shared.wire import MAX_ANSWER_BYTES, MEDIA_TYPE, unpack

router = APIRouter(tags=["cell"], route_class=Negotiated)
uploads = APIRouter(tags=["cell"])

Sha256 = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$", description="Hash of the mesh, as in the cell's document.")]
ObjectName = Annotated[str, Path(max_length=64, description="Name of one of the cell's `objects`.")]

ZIP = "application/zip"

ZIP_TIMEOUT_S = 60.0
"""Time for MAX_ZIP_BYTES over a network that is slow but works."""

WRITTEN_AT_ONCE = 2**20
"""Bytes in one write of a thread; with smaller pieces, the hand-over would cost more than the writing."""


@router.get("/cell", dependencies=READERS)
async def cell(master: ReadableDependency, response: Response) -> dict[str, Any]:
    """Return the cell as a document that names its meshes by sha256; the ETag is the sha256 of the document."""
    published = master.published
    response.headers["ETag"] = f'"{published.reference.sha256}"'
    return published.document


@uploads.put(
    "/cell",
    dependencies=OPERATOR_ONLY,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                ZIP: {"schema": {"type": "string", "format": "binary"}},
                "application/json": {"schema": {"type": "object"}},
            },
        }
    },
)
async def change_cell(request: Request, services: MasterServicesDependency) -> CellAnswer:
    """Watch another cell.

    The body is either its folder as a zip (`cell.yaml` at the root or in the only top folder, with the files that it
    names), or the edited document of `GET /cell`, with meshes of the current cell. An invalid cell changes nothing.
    """
    loader, master = services.loader, services.master
    kind = request.headers.get("content-type", "").split(";")[0].strip().lower()
    async with loader.folder() as folder:
        if kind == ZIP:
            found = await _load_zip(request, loader, folder)
        elif kind in ("application/json", MEDIA_TYPE):
            found = await loader.load_document(await _document(request, kind), master.published)
        else:
            raise Refusal(415, f"cell: expected the Content-Type {ZIP} or application/json, got {kind or 'none'}")
    # Stored before the change and in a thread, since meshes may be large.
    await asyncio.to_thread(master.store.add_meshes, found.meshes)
    return master.change_cell(found)


@router.put("/cell/objects/{name}/pose", dependencies=OPERATOR_ONLY)
async def move_object(name: ObjectName, body: ObjectPoseRequest, master: MasterDependency) -> CellAnswer:
    """Set the pose of a known object; every unit receives it with the answer to its next update."""
    return master.move_object(name, body.T_world_object)


@router.get(
    "/cell/meshes/{sha256}",
    dependencies=READERS,
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}},
)
async def mesh(sha256: Sha256, master: ReadableDependency) -> Response:
    """Return a mesh in its canonical bytes; it never changes, so cache it for ever."""
    data = master.published.meshes.get(sha256)
    if data is None:
        raise Refusal(404, f"mesh {sha256}: it is not part of the current cell")
    return Response(
        data,
        media_type="application/octet-stream",
        headers={"Cache-Control": "public, max-age=31536000, immutable", "ETag": f'"{sha256}"'},
    )


# Its routes read their bodies themselves, since none is a small JSON.
router.include_router(uploads)


async def _load_zip(request: Request, loader: CellLoader, folder: FilePath) -> PublishedCell:
    archive = folder / "cell.zip"
    file = await asyncio.to_thread(archive.open, "wb")
    waiting = bytearray()

    async def add(chunk: bytes) -> None:
        waiting.extend(chunk)
        if len(waiting) >= WRITTEN_AT_ONCE:
            await flush()

    async def flush() -> None:
        await asyncio.to_thread(file.write, bytes(waiting))
        waiting.clear()

    try:
        await pour(request, MAX_ZIP_BYTES, ZIP_TIMEOUT_S, add)
        await flush()
    except OSError as error:
        raise Refusal(507, f"cell: the zip cannot be written to the disk: {error.strerror}") from error
    finally:
        await asyncio.to_thread(file.close)
    return await loader.load_zip(archive, folder)


async def _document(request: Request, kind: str) -> Any:
    body = await body_of(request, MAX_ANSWER_BYTES)
    if kind == MEDIA_TYPE:
        return unpack(body, MAX_ANSWER_BYTES)
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise Refusal(422, f"body: expected JSON, got none: {error}") from error
