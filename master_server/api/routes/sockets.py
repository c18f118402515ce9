# SPDX-License-Identifier: Apache-2.0
"""Serve a WebSocket until one side ends it, or the token that opened it is replaced."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any

from fastapi import WebSocket, WebSocketDisconnect
from fastapi.websockets import WebSocketState

TOKEN_REPLACED = 1008
"""Close code for a socket whose token was replaced: a policy violation by RFC 6455."""


async def serve(
    websocket: WebSocket,
    token_ended: asyncio.Event,
    *works: Coroutine[Any, Any, None],
    gone: tuple[type[Exception], ...] = (),
) -> None:
    """Run all `works` of an accepted socket until one of them ends or the token is replaced.

    Besides `WebSocketDisconnect`, a work raises `gone` when its peer has left. Any other exception is raised once all
    works have ended.
    """
    tasks: list[asyncio.Task[object]] = [asyncio.ensure_future(work) for work in (*works, token_ended.wait())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        ended = await asyncio.gather(*tasks, return_exceptions=True)
    if token_ended.is_set() and websocket.application_state is WebSocketState.CONNECTED:
        with suppress(WebSocketDisconnect):
            await websocket.close(TOKEN_REPLACED, "the token was replaced")
    for outcome in ended:
        if isinstance(outcome, Exception) and not isinstance(outcome, (WebSocketDisconnect, *gone)):
            raise outcome
