# SPDX-License-Identifier: Apache-2.0
"""A WebSocket served until one side goes, or the token that opened it was replaced."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any

from fastapi import WebSocket, WebSocketDisconnect
from fastapi.websockets import WebSocketState

TOKEN_REPLACED = 1008
"""What a socket is closed with whose token holds no more: a policy, says RFC 6455."""


async def serve(
    websocket: WebSocket,
    token_ended: asyncio.Event,
    *works: Coroutine[Any, Any, None],
    gone: tuple[type[Exception], ...] = (),
) -> None:
    """Do the `works` of an accepted socket at once, until one of them ends or the token does.

    `gone` is what a work raises, besides `WebSocketDisconnect`, when the side that it talks to has left; what else
    one raises is raised once all have ended.
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
