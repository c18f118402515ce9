# SPDX-License-Identifier: Apache-2.0
"""The viewer's process, started and served by the master.

Drawing and sending take time that updates would have to wait for, so they have their own process. It starts with the
first browser and ends by itself some time after the last. Its failure does not affect the master.
"""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import socket
import sys
from collections.abc import Coroutine
from importlib.util import find_spec

import httpx
from starlette.types import ASGIApp

from master_server.api.history import History
from master_server.core import Readable
from master_server.recording.replay import Replay
from master_server.security import Access
from master_server.viewer.channel import pack, receive
from master_server.viewer.messages import (
    ApiAnswer,
    ApiRequest,
    BeginAnswer,
    BeginRequest,
    ReadyAnswer,
    ReadyRequest,
    RefusedAnswer,
    Request,
    StateRequest,
    ViewerMessage,
)
from master_server.viewer.sessions import Viewer
from master_server.viewer.snapshot import viewer_state
from shared.clock import monotonic_ns
from shared.errors import Refusal, WireError
from shared.waiting import within

logger = logging.getLogger(__name__)

WINDOW = "master_server.viewer.window"

START_S = 30.0
"""Time for the process to start on a slow and busy machine; it takes 1.5 s on an idle one."""

STOP_S = 0.5
"""Time for the process to end before it is killed."""

REQUESTS_MAX = 16
"""Requests of all browsers in progress at once; further ones are refused until one is done."""

LOCAL = "http://127.0.0.1"


def is_installed() -> bool:
    """Return True if viser is installed."""
    return find_spec("viser") is not None


class ViewerHost:
    """At most one viewer process, and the answers to its requests."""

    def __init__(
        self, app: ASGIApp, master: Readable, history: History, access: Access, actions: dict[str, str]
    ) -> None:
        """`actions` of an operator on a unit: the text of each button, and the address for its POST."""
        self._app = app
        self._master = master
        self._history = history
        self._access = access
        self._actions = actions
        self._starting = asyncio.Lock()
        self._process: asyncio.subprocess.Process | None = None
        self._serving: asyncio.Task[None] | None = None
        self._asks: set[asyncio.Task[None]] = set()
        self._ready = asyncio.Event()
        self.port = 0
        self.key = ""

    @property
    def is_running(self) -> bool:
        """True while the process runs."""
        return self._process is not None and self._process.returncode is None and self._serving is not None

    async def open(self) -> None:
        """Start the process if it does not run, and wait until its `port` and `key` are known.

        Raises:
            Refusal: 503, the process does not start.
        """
        async with self._starting:
            if self.is_running and self._ready.is_set():
                return
            await self.close()
            await self._start()
            if not await within(START_S, self._ready.wait()):
                await self.close()
                raise Refusal(503, f"viewer: it did not start within {START_S:g} s, see the master's log")

    async def close(self) -> None:
        """End it."""
        tasks = [task for task in (self._serving, *self._asks) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._serving = None
        process, self._process = self._process, None
        if process is None or process.returncode is not None:
            return
        # The channel is closed by now, which ends the process.
        if not await within(STOP_S, process.wait()):
            process.kill()
            await process.wait()

    async def _start(self) -> None:
        self._ready.clear()
        self.key = secrets.token_urlsafe()
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                WINDOW,
                str(theirs.fileno()),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                # The viewer has a low priority; and if numerics used all cores, updates would wait.
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
                start_new_session=True,
            )
        ours.setblocking(False)
        reader, writer = await asyncio.open_connection(sock=ours)
        self._serving = asyncio.ensure_future(self._serve(reader, writer))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while (received := await receive(reader)) is not None:
                number, request = received
                if isinstance(request, ApiRequest) and len(self._asks) < REQUESTS_MAX:
                    self._begin(self._call_api(number, request, writer))
                    continue
                writer.write(pack(number, self._answer(request)))
                await writer.drain()
        except (WireError, ConnectionError) as error:
            logger.warning("viewer: %s", error)
        finally:
            writer.close()
            self._ready.clear()
            self._serving = None

    def _answer(self, request: Request) -> ViewerMessage:
        """Answer a request that needs no waiting."""
        if isinstance(request, StateRequest):
            try:
                return viewer_state(self._master, self._history, request, monotonic_ns())
            except Refusal as refusal:
                # A recording may be damaged in its middle.
                return RefusedAnswer(refused=str(refusal))
        if isinstance(request, BeginRequest):
            return BeginAnswer(key=self.key, actions=self._actions, is_replay=isinstance(self._master, Replay))
        if isinstance(request, ReadyRequest):
            self.port = request.port
            self._ready.set()
            return ReadyAnswer()
        return ApiAnswer(status=429, body=b'{"detail": "viewer: too many requests are in progress; try again"}')

    def _begin(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.ensure_future(work)
        self._asks.add(task)
        task.add_done_callback(self._asks.discard)

    async def _call_api(self, number: int, request: ApiRequest, writer: asyncio.StreamWriter) -> None:
        """Answer with the master's own API, with the rights of the browser that sent the request."""
        if request.method != "GET" and request.viewer is not Viewer.OPERATOR:
            status, body = 403, b'{"detail": "this needs the token of the operator"}'
        else:
            # Calls the application directly, without sockets and TLS.
            async with httpx.AsyncClient(transport=httpx.ASGITransport(self._app), base_url=LOCAL) as client:
                response = await client.request(
                    request.method,
                    request.path,
                    json=request.body,
                    headers={"Authorization": f"Bearer {self._access.operator_token.decode()}"},
                )
            status, body = response.status_code, response.content
        try:
            writer.write(pack(number, ApiAnswer(status=status, body=body)))
            await writer.drain()
        except ConnectionError:
            logger.debug("viewer: it ended before the answer was sent")
