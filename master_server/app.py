# SPDX-License-Identifier: Apache-2.0
"""The web application, assembled."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from master_server.api.history import History
from master_server.api.image_requests import ImageRequests
from master_server.api.map_stream import Stream
from master_server.api.metrics import VERSION, Metrics
from master_server.api.openapi import describe, illustrate, serve_documentation
from master_server.api.routes import cell, health, images, map, recording, replay, robot, stream, units
from master_server.api.routes.common import ip_of, log_refusal, refused
from master_server.api.routes.replay import RefusedUpdate
from master_server.api.routes.update import UpdateEndpoint
from master_server.api.services import MasterServices, Services
from master_server.cells.cell_loading import CellLoader
from master_server.core import Master, ReadableCell, Ticker
from master_server.recording.recorder import Recorder
from master_server.recording.replay import Replay
from master_server.security import Access, Limits
from master_server.viewer import proxy
from master_server.viewer.host import ViewerHost
from master_server.viewer.proxy import Gate
from master_server.viewer.sessions import Sessions
from shared.clock import monotonic_ns
from shared.configuration import sentence_of
from shared.errors import CellError, CellwatchError, InputError, Refusal, WireError

TRY_AGAIN_LATER = 1013
"""Close code of a WebSocket after too many requests."""

REPLAY_HEADER = (b"cellwatch-replay", b"true")
"""Header of every answer of a replay, so that nobody mistakes it for live data."""


class Application(FastAPI):
    """FastAPI, except that an update bypasses its routing."""

    services: Services
    update: ASGIApp
    gate: Gate | None = None
    _described_for: ReadableCell | None = None

    def take_updates(self, update: ASGIApp) -> None:
        """Let `update` answer `POST /update`."""
        self.update = update
        self.router.routes.append(Route("/update", update, methods=["POST"]))

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document, with examples for the current cell."""
        master = self.services.master
        if self.openapi_schema is None:
            self.openapi_schema = describe(self, isinstance(self, ReplayApplication))
        if self._described_for is not master.published:
            illustrate(self.openapi_schema, master)
            self._described_for = master.published
        return self.openapi_schema

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await super().__call__(scope, receive, send)
            return
        scope["app"] = self
        # The rate limit comes first, so that a refused caller costs almost nothing.
        try:
            self.services.limits.admit(ip_of(scope), monotonic_ns())
        except Refusal as refusal:
            log_refusal(scope, refusal)
            if scope["type"] == "http":
                await refused(refusal)(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": TRY_AGAIN_LATER, "reason": str(refusal)})
            return
        if scope["type"] == "http" and scope["path"] == "/update" and scope["method"] == "POST":
            await self.update(scope, receive, send)
        else:
            await super().__call__(scope, receive, send)


class ReplayApplication(Application):
    """The same, with each answer marked as that of a replay."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def marked(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.accept", "websocket.http.response.start"):
                message = {**message, "headers": [*message.get("headers", ()), REPLAY_HEADER]}
            await send(message)

        await super().__call__(scope, receive, marked)


def make_app(
    master: Master, access: Access, recorder: Recorder | None = None, limits: Limits | None = None
) -> Application:
    """Return the application of one master; share its `limits` with the acceptor of its connections."""
    routers = [module.router for module in (units, images, cell, map, stream, robot, recording, health)]
    limits = limits or Limits()
    listeners = Stream(master)
    services = MasterServices(
        master=master,
        access=access,
        limits=limits,
        stream=listeners,
        history=History(master),
        recorder=recorder,
        loader=CellLoader(),
        image_requests=ImageRequests(master.registry),
        metrics=Metrics(master, listeners, limits),
        started_at_ns=monotonic_ns(),
    )
    app = _assembled(Application, services, routers, Ticker(master), master.store.follow)
    app.take_updates(UpdateEndpoint(master, services.metrics))
    return app


def make_replay_app(played: Replay, access: Access, limits: Limits | None = None) -> Application:
    """Return the application that serves a recording in place of a master."""
    routers = [module.router for module in (units, cell, map, stream, robot, recording, replay)]
    services = Services(
        master=played, access=access, limits=limits or Limits(), stream=Stream(played), history=History(played)
    )
    app = _assembled(ReplayApplication, services, routers)
    app.take_updates(RefusedUpdate())
    return app


def add_viewer(app: Application, actions: dict[str, str]) -> Gate:
    """Add the viewer under `/viewer/`; it costs nothing until a browser opens it."""
    services = app.services
    host = ViewerHost(app, services.master, services.history, services.access, actions)
    app.gate = Gate(host, Sessions(services.access))
    app.include_router(proxy.router)
    return app.gate


def _assembled(
    kind: type[Application],
    services: Services,
    routers: list[APIRouter],
    ticker: Ticker | None = None,
    *beside: Callable[[], Coroutine[None, None, None]],
) -> Application:
    @asynccontextmanager
    async def running(_: FastAPI) -> AsyncIterator[None]:
        # At start, while nobody waits for it.
        app.openapi()
        if ticker is not None:
            ticker.start()
        works = (services.access.follow, services.history.follow, *beside)
        tasks = [asyncio.create_task(work()) for work in works]
        recorder = services.recorder
        if recorder is not None and recorder.enabled:
            await recorder.begin()
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            if ticker is not None:
                ticker.stop()
            services.stream.stop()
            if app.gate is not None:
                await app.gate.host.close()
            if recorder is not None:
                await recorder.stop()

    app = kind(
        title="Cellwatch master",
        version=VERSION,
        docs_url=None,
        redoc_url=None,
        exception_handlers={
            Refusal: _refused,
            InputError: _refused,
            WireError: _refused,
            CellError: _refused,
            RequestValidationError: _invalid,
        },
        lifespan=running,
    )
    app.services = services
    for router in routers:
        app.include_router(router)
    serve_documentation(app)
    return app


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, CellwatchError)
    log_refusal(request.scope, error)
    return refused(error)


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    items = error.errors()
    if items and items[0]["type"] == "json_invalid":
        reason = items[0].get("ctx", {}).get("error", "it is malformed")
        sentence = f"body: expected JSON, got none: {reason} at {items[0]['loc'][-1]}"
    else:
        sentence = sentence_of(items)
    return await _refused(request, Refusal(422, sentence))
