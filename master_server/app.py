# SPDX-License-Identifier: Apache-2.0
"""The web application, assembled."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from master_server.access import Access
from master_server.cell_loading import CellLoader
from master_server.limits import Limits
from master_server.master import Master
from master_server.metrics import Metrics
from master_server.recording import Recorder
from master_server.routes import cell, health, map, recording, robot, stream, units
from master_server.routes.common import ip_of, refused
from master_server.routes.update import UpdateEndpoint
from master_server.stream import Stream
from shared.clock import monotonic_ns
from shared.configuration import sentence_of
from shared.errors import CellError, CellwatchError, InputError, Refusal, WireError

TRY_AGAIN_LATER = 1013
"""What a WebSocket is closed with when there were too many."""


class Application(FastAPI):
    """FastAPI, but for the one path that takes an update: it is spared the way through it."""

    update: UpdateEndpoint

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await super().__call__(scope, receive, send)
            return
        # Before anything else, so that whom it refuses costs next to nothing.
        try:
            self.state.limits.admit(ip_of(scope), monotonic_ns())
        except Refusal as refusal:
            if scope["type"] == "http":
                await refused(refusal)(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": TRY_AGAIN_LATER, "reason": str(refusal)})
            return
        if scope["type"] == "http" and scope["path"] == "/update" and scope["method"] == "POST":
            scope["app"] = self
            await self.update(scope, receive, send)
        else:
            await super().__call__(scope, receive, send)


def make_app(
    master: Master, access: Access, recorder: Recorder | None = None, limits: Limits | None = None
) -> Application:
    """The application that serves one master; `limits` are shared with what holds its connections."""
    listeners = Stream(master)
    metrics = Metrics(master, listeners)
    update = UpdateEndpoint(master, metrics)

    @asynccontextmanager
    async def running(app: FastAPI) -> AsyncIterator[None]:
        listeners.start()
        if recorder is not None and recorder.enabled:
            await recorder.begin()
        try:
            yield
        finally:
            listeners.stop()
            if recorder is not None:
                await recorder.stop()

    app = Application(
        title="Cellwatch master",
        description=(master.__doc__ or "").splitlines()[0],
        exception_handlers={
            Refusal: _refused,
            InputError: _refused,
            WireError: _refused,
            CellError: _refused,
            RequestValidationError: _invalid,
        },
        routes=[Route("/update", update, methods=["POST"])],
        lifespan=running,
    )
    app.update = update
    app.state.master = master
    app.state.access = access
    app.state.limits = limits or Limits()
    app.state.loader = CellLoader()
    app.state.stream = listeners
    app.state.recorder = recorder
    app.state.metrics = metrics
    app.state.started_at_ns = monotonic_ns()
    for module in (units, cell, map, stream, robot, recording, health):
        app.include_router(module.router)
    return app


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, CellwatchError)
    return refused(error)


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    items = error.errors()
    if items and items[0]["type"] == "json_invalid":
        reason = items[0].get("ctx", {}).get("error", "it is malformed")
        return JSONResponse({"detail": f"body: expected JSON, got none: {reason} at {items[0]['loc'][-1]}"}, 422)
    return JSONResponse({"detail": sentence_of(items)}, 422)
