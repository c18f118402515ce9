# SPDX-License-Identifier: Apache-2.0
"""Shared parts of all routes: bounded bodies, JSON or msgpack, tokens."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Coroutine
from typing import Annotated, Any

import msgpack
from fastapi import Depends, Request, Response
from fastapi.routing import APIRoute
from fastapi.security import HTTPBearer
from starlette.requests import ClientDisconnect, HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import Message, Scope

from master_server.api.map_stream import Stream
from master_server.api.services import MasterServices, Services
from master_server.core import Master, Readable
from master_server.security import Access, Limits, Role, plain_ip
from master_server.security.auth import ANYONE, OPERATORS, UNITS
from shared.clock import monotonic_ns
from shared.errors import CellwatchError, Refusal, WireError
from shared.waiting import at_once_or_within, within
from shared.wire import MEDIA_TYPE, unpack

logger = logging.getLogger(__name__)

MAX_BODY_BYTES = 2**18
"""Bound of each request except updates, cells and meshes: settings, a pose, joints."""

BODY_TIMEOUT_S = 5.0
"""A unit sends a body in one go; a slower sender would hold a connection for nothing."""

CLOSING = frozenset({401, 408, 413, 429})
"""Refusals before the body was read; the rest of the body is never read."""
SHOWN_PATH_CHARS = 100
"""More than the longest path that the master has."""

IS_REPLAY = "this is a replay: nothing in it can be changed"


async def body_of(request: Request, max_bytes: int) -> bytes:
    """Read the whole body.

    Raises:
        Refusal: 413, more than `max_bytes`; 408, it came too slowly; 400, the sender closed the connection.
    """
    _check_declared(request, max_bytes)
    body = bytearray()
    try:
        if not await at_once_or_within(BODY_TIMEOUT_S, _read(request, max_bytes, body)):
            raise Refusal(408, f"body: expected all of it within {BODY_TIMEOUT_S:g} s, got {len(body)} bytes")
    except ClientDisconnect as error:
        raise Refusal(400, "body: the sender closed the connection") from error
    limits_of(request).read(ip_of(request.scope), len(body), monotonic_ns())
    return bytes(body)


async def pour(
    request: Request, max_bytes: int, timeout_s: float, add: Callable[[bytes], Coroutine[Any, Any, None]]
) -> None:
    """Pass on a large body as it arrives.

    Raises:
        Refusal: as in `body_of`.
    """
    _check_declared(request, max_bytes)
    count = 0

    async def read() -> None:
        nonlocal count
        async for chunk in request.stream():
            count += len(chunk)
            if count > max_bytes:
                raise Refusal(413, f"body: expected at most {max_bytes} bytes, got more")
            await add(chunk)

    try:
        if not await within(timeout_s, read()):
            raise Refusal(408, f"body: expected all of it within {timeout_s:g} s, got {count} bytes")
    except ClientDisconnect as error:
        raise Refusal(400, "body: the sender closed the connection") from error


def ip_of(scope: Scope) -> str:
    """Return the remote address of the connection; headers are ignored."""
    client = scope.get("client")
    if client is None:
        raise Refusal(400, "the connection has no address")
    return plain_ip(str(client[0]))


def status_of(error: CellwatchError) -> int:
    """Return the HTTP status of an error; an error without its own status is invalid input."""
    return error.status if isinstance(error, Refusal) else 422


def refused(error: CellwatchError) -> Response:
    """Return a refusal in the form of every route: one sentence."""
    status = status_of(error)
    headers = {"Connection": "close"} if status in CLOSING else {}
    if isinstance(error, Refusal) and error.retry_after_s is not None:
        headers["Retry-After"] = str(error.retry_after_s)
    return JSONResponse({"detail": str(error)}, status, headers)


def log_refusal(scope: Scope, error: CellwatchError) -> None:
    """Log a refused request in one line, without the query, which is private to the caller."""
    status = status_of(error)
    client = scope.get("client")
    ip = plain_ip(str(client[0])) if client else ""
    if not limits_of(HTTPConnection(scope)).may_be_logged(ip, monotonic_ns()):
        return
    # A stranger may request any path.
    path = repr(scope["path"])[1:-1][:SHOWN_PATH_CHARS]
    requested = f"{scope.get('method', 'WS')} {path}"
    fields = {"event": "refusal", "ip": ip, "status": status}
    logger.warning("%s from %s refused: %d, %s", requested, ip, status, error, extra=fields)


class Negotiated(APIRoute):
    """JSON by default, msgpack if `Content-Type` or `Accept` says so; every body is bounded.

    Refusals are JSON always.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handler = super().get_route_handler()

        async def negotiated(request: Request) -> Response:
            response = await handler(await _as_json(request))
            if response.body and response.media_type == "application/json" and wants_msgpack(request):
                packed = msgpack.packb(json.loads(bytes(response.body)))
                return Response(packed, response.status_code, media_type=MEDIA_TYPE)
            return response

        return negotiated


def wants_msgpack(request: Request) -> bool:
    """Return True if the caller requests msgpack."""
    return MEDIA_TYPE in request.headers.get("accept", "")


# All dependencies are coroutines: the framework runs plain functions in a thread, at ten times the cost.


async def services_of(request: HTTPConnection) -> Services:
    """Return the objects that the routes of this application use."""
    return _services(request)


async def master_services_of(request: HTTPConnection) -> MasterServices:
    """Return the services of a master, for routes that change something.

    Raises:
        Refusal: 409, it is a replay.
    """
    services = _services(request)
    if not isinstance(services, MasterServices):
        raise Refusal(409, IS_REPLAY)
    return services


ServicesDependency = Annotated[Services, Depends(services_of)]
MasterServicesDependency = Annotated[MasterServices, Depends(master_services_of)]


async def master_of(services: MasterServicesDependency) -> Master:
    """Return the master of this application; raises as `master_services_of`."""
    return services.master


async def readable_of(services: ServicesDependency) -> Readable:
    """Return the master of this application, or its recording, for routes that only read."""
    return services.master


def access_of(request: HTTPConnection) -> Access:
    """Return the tokens of this application."""
    return _services(request).access


def limits_of(request: HTTPConnection) -> Limits:
    """Return the rate limits of this application."""
    return _services(request).limits


def stream_of(request: HTTPConnection) -> Stream:
    """Return the stream of this application."""
    return _services(request).stream


def _services(request: HTTPConnection) -> Services:
    services = request.app.services
    assert isinstance(services, Services)
    return services


def role_of(request: HTTPConnection, allowed: frozenset[Role], authorization: bytes | None = None) -> Role:
    """Return the role of the token in this request's header, or in `authorization` in the same form.

    Raises:
        Refusal: 401 without a valid one, 403 with one of another role, 429 after too many wrong ones.
    """
    authorization = authorization or authorization_of(request)
    access = access_of(request)
    if authorization is None:
        return access.check(None, allowed)
    limits, ip, now_ns = limits_of(request), ip_of(request.scope), monotonic_ns()
    limits.may_show_token(ip, now_ns)
    try:
        role = access.check(authorization, ANYONE)
    except Refusal:
        limits.token_was_wrong(ip, now_ns)
        raise
    limits.token_was_right(ip, now_ns)
    return role if role in allowed else access.check(authorization, allowed)


def authorization_of(request: HTTPConnection) -> bytes | None:
    """Return the `Authorization` header unchanged."""
    return next((value for name, value in request.scope["headers"] if name == b"authorization"), None)


async def may_read(request: Request) -> None:
    """Dependency: any token, or none if reads are public."""
    if not access_of(request).public_reads:
        role_of(request, ANYONE)


async def is_operator(request: Request) -> None:
    """Dependency: the operator's token."""
    role_of(request, OPERATORS)


async def is_unit(request: Request) -> None:
    """Dependency: the units' token."""
    role_of(request, UNITS)


async def is_known(request: Request) -> Role:
    """Dependency: either token; returns its role."""
    return role_of(request, ANYONE)


# Only for the OpenAPI document; the checks are above.
bearer = Depends(HTTPBearer(auto_error=False, description="The token of the units or of the operator."))

MasterDependency = Annotated[Master, Depends(master_of)]
ReadableDependency = Annotated[Readable, Depends(readable_of)]
READERS = [bearer, Depends(may_read)]
OPERATOR_ONLY = [bearer, Depends(is_operator)]
UNIT_ONLY = [bearer, Depends(is_unit)]


def _check_declared(request: Request, max_bytes: int) -> None:
    declared = request.headers.get("content-length", "0")
    if declared.isdigit() and int(declared) > max_bytes:
        raise Refusal(413, f"body: expected at most {max_bytes} bytes, got {declared}")


async def _read(request: Request, max_bytes: int, body: bytearray) -> None:
    async for chunk in request.stream():
        body += chunk
        if len(body) > max_bytes:
            raise Refusal(413, f"body: expected at most {max_bytes} bytes, got more")


async def _as_json(request: Request) -> Request:
    """Return the same request with its body read within bounds, and as JSON if it was msgpack."""
    if request.method in ("GET", "DELETE", "HEAD"):
        return request
    # Before anything is read, so that a stranger costs nothing. Each route checks the role of the token.
    role_of(request, ANYONE)
    body = await body_of(request, MAX_BODY_BYTES)
    headers = request.scope["headers"]
    if request.headers.get("content-type", "").split(";")[0].strip() == MEDIA_TYPE:
        try:
            body = json.dumps(unpack(body, MAX_BODY_BYTES)).encode()
        except (TypeError, ValueError) as error:
            raise WireError(f"body: expected msgpack of what JSON can hold: {error}") from error
        except RecursionError as error:
            raise WireError("body: expected values in a few levels, got them nested too deeply") from error
        headers = [(name, value) for name, value in headers if name not in (b"content-type", b"content-length")]
        headers += [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    else:
        try:
            body.decode()
        except UnicodeDecodeError as error:
            raise WireError(f"body: expected JSON in UTF-8: {error.reason} at byte {error.start}") from error

    async def receive() -> Message:
        return {"type": "http.request", "body": body, "more_body": False}

    return Request({**request.scope, "headers": headers}, receive)
