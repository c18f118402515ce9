# SPDX-License-Identifier: Apache-2.0
"""The viewer's process, started and served by the master.

What it draws and sends takes time that updates would otherwise wait for. It is started with the first who looks, and
ends by itself when nobody does; a viewer that fails takes nothing with it.
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
    LookRequest,
    ReadyAnswer,
    ReadyRequest,
    RefusedAnswer,
    Request,
    ViewerMessage,
)
from master_server.viewer.sessions import Viewer
from master_server.viewer.snapshot import look
from shared.clock import monotonic_ns
from shared.errors import Refusal, WireError
from shared.waiting import within

logger = logging.getLogger(__name__)

WINDOW = "master_server.viewer.window"

START_S = 30.0
"""For the process to be there on a slow and busy machine; 1.5 s on a quiet one."""

STOP_S = 0.5
"""Until it is killed."""

ASKS_MAX = 16
"""Requests of all who look that are under way at once; who clicks on is told to wait."""

LOCAL = "http://127.0.0.1"


def is_installed() -> bool:
    """Whether there is anything to draw with."""
    return find_spec("viser") is not None


class ViewerHost:
    """One viewer process at most, and what it asks."""

    def __init__(
        self, app: ASGIApp, master: Readable, history: History, access: Access, actions: dict[str, str]
    ) -> None:
        """`actions` of an operator on a unit: what a button says, and the address that it posts to."""
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
        """Whether the process is there."""
        return self._process is not None and self._process.returncode is None and self._serving is not None

    async def open(self) -> None:
        """Have it run, and its `port` and `key` known.

        Raises:
            Refusal: 503, it does not start.
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
        # The channel is closed by now, by which it knows.
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
                # A window is not what the machine is there for; and where numerics spread over all cores, updates wait.
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
                start_new_session=True,
            )
        ours.setblocking(False)
        reader, writer = await asyncio.open_connection(sock=ours)
        self._serving = asyncio.ensure_future(self._serve(reader, writer))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while (asked := await receive(reader)) is not None:
                number, request = asked
                if isinstance(request, ApiRequest) and len(self._asks) < ASKS_MAX:
                    self._begin(self._ask(number, request, writer))
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
        """What can be told at once."""
        if isinstance(request, LookRequest):
            try:
                return look(self._master, self._history, request, monotonic_ns())
            except Refusal as refusal:
                # A recording may be damaged in its middle.
                return RefusedAnswer(refused=str(refusal))
        if isinstance(request, BeginRequest):
            return BeginAnswer(key=self.key, actions=self._actions, is_replay=isinstance(self._master, Replay))
        if isinstance(request, ReadyRequest):
            self.port = request.port
            self._ready.set()
            return ReadyAnswer()
        return ApiAnswer(status=429, body=b'{"detail": "too much is asked at once"}')

    def _begin(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.ensure_future(work)
        self._asks.add(task)
        task.add_done_callback(self._asks.discard)

    async def _ask(self, number: int, request: ApiRequest, writer: asyncio.StreamWriter) -> None:
        """Answer by the same API that anyone may ask, as the person who looks may ask it."""
        if request.method != "GET" and request.viewer is not Viewer.OPERATOR:
            status, body = 403, b'{"detail": "this needs the token of the operator"}'
        else:
            # Without the way through sockets and TLS.
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
            logger.debug("viewer: it is gone before it was answered")
