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
from master_server.master import Master
from master_server.metrics import Metrics
from master_server.recording import Recorder
from master_server.routes import cell, health, map, recording, robot, stream, units
from master_server.routes.update import UpdateEndpoint
from master_server.stream import Stream
from shared.clock import monotonic_ns
from shared.configuration import sentence_of
from shared.errors import CellError, CellwatchError, InputError, Refusal, WireError


class Application(FastAPI):
    """FastAPI, but for the one path that takes an update: it is spared the way through it."""

    update: UpdateEndpoint

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["path"] == "/update" and scope["method"] == "POST":
            await self.update(scope, receive, send)
        else:
            await super().__call__(scope, receive, send)


def make_app(master: Master, access: Access, recorder: Recorder | None = None) -> Application:
    """The application that serves one master."""
    listeners = Stream(master)
    metrics = Metrics(master, listeners)
    update = UpdateEndpoint(master, access, metrics)

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
    return JSONResponse({"detail": str(error)}, error.status if isinstance(error, Refusal) else 422)


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    items = error.errors()
    if items and items[0]["type"] == "json_invalid":
        reason = items[0].get("ctx", {}).get("error", "it is malformed")
        return JSONResponse({"detail": f"body: expected JSON, got none: {reason} at {items[0]['loc'][-1]}"}, 422)
    return JSONResponse({"detail": sentence_of(items)}, 422)
