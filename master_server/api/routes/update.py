# SPDX-License-Identifier: Apache-2.0
"""`POST /update`: decode, merge, answer, without a framework in between.

Fifty units at 30 frames a second call it 1,500 times a second.
"""

from __future__ import annotations

from starlette.requests import Request
from starlette.types import Receive, Scope, Send

from master_server.api.metrics import Metrics
from master_server.api.routes.common import body_of, ip_of, log_refusal, refused, role_of, status_of
from master_server.core import Master
from master_server.security.auth import UNITS
from shared.clock import monotonic_ns
from shared.errors import Refusal, WireError
from shared.wire import MAX_UPDATE_BYTES, MEDIA_TYPE, decode_update, encode_update_answer

CONTENT_TYPE = (b"content-type", MEDIA_TYPE.encode())


class UpdateEndpoint:
    """An ASGI application for the one path."""

    def __init__(self, master: Master, metrics: Metrics) -> None:
        self._master = master
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope, receive)
        try:
            body = await self._answer(request)
        except (Refusal, WireError) as error:
            self._metrics.refused(status_of(error))
            log_refusal(scope, error)
            await refused(error)(scope, receive, send)
        else:
            length = (b"content-length", str(len(body)).encode())
            await send({"type": "http.response.start", "status": 200, "headers": [CONTENT_TYPE, length]})
            await send({"type": "http.response.body", "body": body})

    async def _answer(self, request: Request) -> bytes:
        role_of(request, UNITS)
        body = await body_of(request, MAX_UPDATE_BYTES)
        received_at_ns = monotonic_ns()
        update = decode_update(body)
        answer = self._master.update(update, ip_of(request.scope), received_at_ns)
        answered = encode_update_answer(answer, monotonic_ns())
        self._metrics.accepted(update.id, len(body), monotonic_ns() - received_at_ns)
        return answered
