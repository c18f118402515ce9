# SPDX-License-Identifier: Apache-2.0
"""`WS /stream`: the merged map as it changes.

A token comes in the `Authorization` header or, since browsers cannot set one, as the WebSocket subprotocol
`bearer.<token>` beside `cellwatch`. It is taken from no address: those stand in histories and in the logs of proxies.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Literal

from fastapi import APIRouter, WebSocket
from pydantic import BaseModel, ConfigDict, ValidationError

from master_server.api.map_stream import Listener, Wish
from master_server.api.responses import Form
from master_server.api.routes.common import access_of, ip_of, log_refusal, refused, role_of, stream_of
from master_server.api.routes.sockets import serve
from master_server.security.auth import ANYONE
from shared.configuration import sentence
from shared.errors import Refusal

logger = logging.getLogger(__name__)

router = APIRouter(tags=["map"])

SUBPROTOCOL = "cellwatch"
"""What the master agrees to: a browser wants one of those that it offered, and the token must not come back."""

BEARER = "bearer."


class StreamQuery(BaseModel):
    """How the reader wants it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    form: Form = "indices"
    encoding: Literal["msgpack", "json"] = "msgpack"
    unseen: bool = False


@router.websocket("/stream")
async def stream(websocket: WebSocket) -> None:
    """The newest map at each change, as `StreamMessage`; who is slow skips."""
    source = stream_of(websocket)
    try:
        _refuse_token(websocket)
        access = access_of(websocket)
        # A public stream was opened with no token that could be replaced.
        token_ended = asyncio.Event()
        if not access.public_reads:
            token_ended = access.end_of(role_of(websocket, ANYONE, _authorization(websocket)))
        listener = source.listen(_wish(websocket))
    except Refusal as refusal:
        log_refusal(websocket.scope, refusal)
        await websocket.send_denial_response(refused(refusal))
        return
    fields = {"event": "stream", "ip": ip_of(websocket.scope)}
    with listener:
        await websocket.accept(SUBPROTOCOL if SUBPROTOCOL in websocket.scope["subprotocols"] else None)
        logger.info("reader %s listens (%d in all)", fields["ip"], len(source), extra=fields)
        try:
            await serve(websocket, token_ended, _send(websocket, listener), _until_gone(websocket))
        finally:
            sent, skipped = listener.sent, listener.skipped
            logger.info("reader %s is gone: %d messages sent, %d skipped", fields["ip"], sent, skipped, extra=fields)


async def _send(websocket: WebSocket, listener: Listener) -> None:
    while True:
        message = await listener.next()
        if isinstance(message, str):
            await websocket.send_text(message)
        else:
            await websocket.send_bytes(message)


async def _until_gone(websocket: WebSocket) -> None:
    """Take in, and pass over, whatever a reader says."""
    while (await websocket.receive())["type"] != "websocket.disconnect":
        pass


def _authorization(websocket: WebSocket) -> bytes | None:
    header = next((value for name, value in websocket.scope["headers"] if name == b"authorization"), None)
    if header is not None:
        return bytes(header)
    for offered in websocket.scope["subprotocols"]:
        if offered.startswith(BEARER):
            return f"Bearer {offered.removeprefix(BEARER)}".encode()
    return None


def _refuse_token(websocket: WebSocket) -> None:
    """Whoever puts a token here learns it at once, whether it is the right one or not."""
    if "token" in websocket.query_params:
        raise Refusal(400, "token: expected in the Authorization header or as subprotocol bearer.<token>, not here")


def _wish(websocket: WebSocket) -> Wish:
    try:
        query = StreamQuery.model_validate(dict(websocket.query_params))
    except ValidationError as error:
        raise Refusal(422, sentence(error)) from error
    return Wish(query.form, query.encoding, query.unseen)
