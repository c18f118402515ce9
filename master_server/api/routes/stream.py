# SPDX-License-Identifier: Apache-2.0
"""`WS /stream`: the merged map as it changes.

A token comes in the `Authorization` header or, since browsers cannot set one, as the WebSocket subprotocol
`bearer.<token>` beside `cellwatch`. It is never taken from an address, since histories and proxy logs keep addresses.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Literal

from fastapi import APIRouter, WebSocket
from pydantic import BaseModel, ConfigDict, ValidationError

from master_server.api.map_stream import Listener, StreamFormat
from master_server.api.responses import Form
from master_server.api.routes.common import access_of, ip_of, log_refusal, refused, role_of, stream_of
from master_server.api.routes.sockets import serve
from master_server.security.auth import ANYONE
from shared.configuration import sentence
from shared.errors import Refusal

logger = logging.getLogger(__name__)

router = APIRouter(tags=["map"])

SUBPROTOCOL = "cellwatch"
"""The agreed subprotocol: a browser requires one of those that it offered, and the token must not be sent back."""

BEARER = "bearer."


class StreamQuery(BaseModel):
    """The format that the reader requests."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    form: Form = "indices"
    encoding: Literal["msgpack", "json"] = "msgpack"
    unseen: bool = False


@router.websocket("/stream")
async def stream(websocket: WebSocket) -> None:
    """Send the newest map at each change, as `StreamMessage`; a slow reader skips messages."""
    source = stream_of(websocket)
    try:
        _refuse_token(websocket)
        access = access_of(websocket)
        # A public stream was opened without a token, so none can be replaced.
        token_ended = asyncio.Event()
        if not access.public_reads:
            token_ended = access.end_of(role_of(websocket, ANYONE, _authorization(websocket)))
        listener = source.listen(_format_of(websocket))
    except Refusal as refusal:
        log_refusal(websocket.scope, refusal)
        await websocket.send_denial_response(refused(refusal))
        return
    fields = {"event": "stream", "ip": ip_of(websocket.scope)}
    with listener:
        await websocket.accept(SUBPROTOCOL if SUBPROTOCOL in websocket.scope["subprotocols"] else None)
        logger.info("reader %s connected (%d in all)", fields["ip"], len(source), extra=fields)
        try:
            await serve(websocket, token_ended, _send(websocket, listener), _until_gone(websocket))
        finally:
            sent, skipped = listener.sent, listener.skipped
            text = "reader %s disconnected: %d messages sent, %d skipped"
            logger.info(text, fields["ip"], sent, skipped, extra=fields)


async def _send(websocket: WebSocket, listener: Listener) -> None:
    while True:
        message = await listener.next()
        if isinstance(message, str):
            await websocket.send_text(message)
        else:
            await websocket.send_bytes(message)


async def _until_gone(websocket: WebSocket) -> None:
    """Receive and ignore all messages of a reader until it disconnects."""
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
    """Refuse a token in the address, valid or not, so that its sender learns it at once."""
    if "token" in websocket.query_params:
        raise Refusal(400, "token: expected in the Authorization header or as subprotocol bearer.<token>, not here")


def _format_of(websocket: WebSocket) -> StreamFormat:
    try:
        query = StreamQuery.model_validate(dict(websocket.query_params))
    except ValidationError as error:
        raise Refusal(422, sentence(error)) from error
    return StreamFormat(query.form, query.encoding, query.unseen)
