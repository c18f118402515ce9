# SPDX-License-Identifier: Apache-2.0
"""Control a replay, and refuse updates to it."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends
from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send

from master_server.api.routes.common import IS_REPLAY, OPERATOR_ONLY, READERS, Negotiated, ReadableDependency
from master_server.recording.replay import Replay, ReplayAnswer, ReplayRequest
from shared.clock import monotonic_ns

router = APIRouter(tags=["replay"], route_class=Negotiated)


async def replay_of(master: ReadableDependency) -> Replay:
    """Return the replay of this application."""
    assert isinstance(master, Replay)
    return master


ReplayDependency = Annotated[Replay, Depends(replay_of)]


@router.get("/replay", dependencies=READERS)
async def replay(replay: ReplayDependency) -> ReplayAnswer:
    """Return the state of the replay."""
    return replay.answer(monotonic_ns())


@router.put("/replay", dependencies=OPERATOR_ONLY)
async def change_replay(body: ReplayRequest, replay: ReplayDependency) -> ReplayAnswer:
    """Seek, pause, or play at another speed."""
    return replay.change(body, monotonic_ns())


@router.get("/healthz")
async def healthz() -> dict[str, Any]:
    """Answer while the event loop runs, and state that this is a replay, not a master."""
    return {"status": "ok", "replay": True}


class RefusedUpdate:
    """`POST /update` of a unit that mistakes a replay for a master: an ASGI application for the one path."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await JSONResponse({"detail": IS_REPLAY}, 409)(scope, receive, send)
