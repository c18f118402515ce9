# SPDX-License-Identifier: Apache-2.0
"""`/viewer/`: the page, the exchange of a link for a cookie, and the WebSocket to the viewer's process.

The master itself serves the page. Of a browser's messages, only the actions of a user in the viewer are forwarded. In
particular, a request for a tunnel to a host of viser's makers is not.
"""

from __future__ import annotations

import asyncio
import base64
import gzip
import hashlib
import logging
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

import msgpack
from fastapi import APIRouter, Request, Response, WebSocket
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from master_server.api.routes.common import OPERATOR_ONLY, access_of, ip_of, limits_of, log_refusal, refused, role_of
from master_server.api.routes.sockets import serve
from master_server.security.auth import ANYONE
from master_server.security.tokens import TOKEN_MAX_CHARS
from master_server.viewer.host import ViewerHost
from master_server.viewer.sessions import SESSION_S, SIGNED_WITH, Sessions, Viewer, viewer_of
from shared.clock import monotonic_ns, wall_ns
from shared.errors import Refusal

logger = logging.getLogger(__name__)

router = APIRouter(include_in_schema=False)

PAGE = "/viewer/"

VIEWERS_MAX = 16
"""A control room and some telephones; each costs the machine some per cent of a core."""

MESSAGE_MAX_BYTES = 2**26
"""Bound of a message from the viewer's process: the whole cell at once, for a new browser."""

PASSED = frozenset({"ViewerCameraMessage", "GuiUpdateMessage"})
"""Forwarded messages of a browser: its camera, and the use of a control."""

CHANGED = frozenset({"value"})
"""Fields of a control that a browser may change; bounds and callbacks are excluded."""

UNAVAILABLE = 1013
"""Close code of a WebSocket if the viewer does not run."""

LOGIN_SCRIPT = """
const say = text => document.querySelector('output').textContent = text;
async function enter(body) {
  say('...');
  try {
    const answer = await fetch('login', {method: 'POST', headers: {'Content-Type': 'application/json'},
                                         body: JSON.stringify(body)});
    if (answer.ok) { location.replace('./'); return; }
    say((await answer.json()).detail);
  } catch (error) { say('The master does not answer.'); }
}
document.querySelector('form').addEventListener('submit', event => {
  event.preventDefault();
  enter({token: document.querySelector('input').value.trim()});
});
const code = location.hash.slice(1);
if (code) { history.replaceState(null, '', location.pathname); enter({code}); }
"""

LOGIN_STYLE = "body{font:16px sans-serif;max-width:34em;margin:15vh auto;padding:0 1em}input{width:100%;margin:.5em 0}"

LOGIN_PAGE = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Cellwatch</title><link rel="icon" href="data:,">
<style>{LOGIN_STYLE}</style>
<h1>Cellwatch</h1>
<p>Open the link that the master printed at its start, or enter the token of the operator (view and change)
or of the units (view only).</p>
<form><input type="password" aria-label="token" autocomplete="off" maxlength="{TOKEN_MAX_CHARS}" required>
<button>Enter</button></form>
<p><output></output></p>
<script>{LOGIN_SCRIPT}</script>
</html>
"""


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


COMMON_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
}
LOGIN_HEADERS = COMMON_HEADERS | {
    "Content-Security-Policy": "default-src 'none'; connect-src 'self'; img-src data:; frame-ancestors 'none'; "
    f"form-action 'none'; base-uri 'none'; script-src {_hash(LOGIN_SCRIPT)}; style-src {_hash(LOGIN_STYLE)}",
}
# The page is one file, which unpacks itself; the browser enforces that nothing else is loaded.
PAGE_HEADERS = COMMON_HEADERS | {
    "Content-Security-Policy": "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; connect-src 'self' data: "
    "blob:; frame-ancestors 'none'; form-action 'none'; base-uri 'none'",
    "Content-Encoding": "gzip",
}


class LoginRequest(BaseModel):
    """A code or a token; one of the two."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    code: str | None = Field(default=None, max_length=TOKEN_MAX_CHARS)
    token: str | None = Field(default=None, max_length=TOKEN_MAX_CHARS)


class Gate:
    """The objects that the routes below need: access, and the viewer's process."""

    def __init__(self, host: ViewerHost, sessions: Sessions) -> None:
        self.host = host
        self.sessions = sessions
        self.connected = 0
        self._page: bytes | None = None

    async def page(self) -> bytes:
        """Return viser's single page, compressed."""
        if self._page is None:
            self._page = await asyncio.to_thread(_read_page)
        return self._page


def _read_page() -> bytes:
    spec = find_spec("viser")
    assert spec is not None
    assert spec.origin is not None
    text = (Path(spec.origin).parent / "client" / "build" / "index.html").read_bytes()
    return gzip.compress(text.replace(b"<title>Viser</title>", b"<title>Cellwatch</title>", 1), mtime=0)


def _gate(connection: HTTPConnection) -> Gate:
    gate = connection.app.gate
    assert isinstance(gate, Gate)
    return gate


def cookie_name(connection: HTTPConnection) -> str:
    """Return the cookie's name with the port: all ports of a host share their cookies, and each may be a master."""
    return f"cellwatch-viewer-{connection.scope['server'][1]}"


def _viewer_of(connection: HTTPConnection) -> Viewer | None:
    """Return the caller's rights; None without a cookie or token if one is required."""
    cookie = connection.cookies.get(cookie_name(connection), "")
    viewer = _gate(connection).sessions.viewer(cookie, wall_ns())
    if viewer is None and "authorization" in connection.headers:
        viewer = viewer_of(role_of(connection, ANYONE))
    if viewer is None and access_of(connection).public_reads:
        viewer = Viewer.READER
    return viewer


@router.get("/viewer")
async def without_slash() -> Response:
    """Redirect to the address with a slash, since the page finds its socket relative to it."""
    return RedirectResponse(PAGE, 308)


@router.get(PAGE)
async def page(request: Request) -> Response:
    """Return the viewer, or the login page."""
    if _viewer_of(request) is None:
        return Response(LOGIN_PAGE, 401, LOGIN_HEADERS, "text/html; charset=utf-8")
    return Response(await _gate(request).page(), 200, PAGE_HEADERS, "text/html; charset=utf-8")


@router.get("/viewer/login")
async def login_page() -> Response:
    """Return the target of links; their code stays in the browser until the page sends it."""
    return Response(LOGIN_PAGE, 200, LOGIN_HEADERS, "text/html; charset=utf-8")


@router.post("/viewer/login", status_code=204)
async def login(body: LoginRequest, request: Request) -> Response:
    """Exchange a code or a token for a cookie."""
    _refuse_other_pages(request)
    gate, limits, ip, now_ns = _gate(request), limits_of(request), ip_of(request.scope), monotonic_ns()
    if body.token is not None:
        viewer = viewer_of(role_of(request, ANYONE, b"Bearer " + body.token.encode("utf-8", "replace")))
    elif body.code is not None:
        limits.may_show_token(ip, now_ns)
        try:
            viewer = gate.sessions.redeem(body.code, now_ns)
        except Refusal:
            limits.token_was_wrong(ip, now_ns)
            raise
    else:
        raise Refusal(422, "body: expected a code or a token, got neither")
    response = Response(status_code=204, headers={"Cache-Control": "no-store"})
    response.set_cookie(
        cookie_name(request),
        gate.sessions.cookie(viewer, wall_ns()),
        max_age=SESSION_S,
        path="/viewer",
        secure=request.url.scheme == "https",
        httponly=True,
        samesite="strict",
    )
    logger.info("viewer: %s entered as %s", ip, viewer.value, extra={"event": "viewer", "ip": ip})
    return response


@router.post("/viewer/links", dependencies=OPERATOR_ONLY)
async def make_link(request: Request) -> dict[str, str]:
    """Return a link that makes the first browser that opens it an operator; valid for some minutes."""
    return {"path": link_path(_gate(request).sessions)}


def link_path(sessions: Sessions) -> str:
    """Return the path behind the master's address that opens the viewer once."""
    return f"{PAGE}login#{sessions.make_code(monotonic_ns())}"


@router.websocket("/viewer")
@router.websocket(PAGE)
async def window(websocket: WebSocket) -> None:
    """Forward messages between the page and the viewer's process."""
    gate = _gate(websocket)
    try:
        _refuse_other_pages(websocket)
        viewer = _viewer_of(websocket)
        if viewer is None:
            raise Refusal(401, "viewer: expected the cookie of a login, or a token")
        token_ended = access_of(websocket).end_of(SIGNED_WITH[viewer])
        if gate.connected >= VIEWERS_MAX:
            raise Refusal(503, f"viewer: expected at most {VIEWERS_MAX} browsers, so many are connected; close one")
        await gate.host.open()
    except Refusal as refusal:
        log_refusal(websocket.scope, refusal)
        await websocket.send_denial_response(refused(refusal))
        return
    fields = {"event": "viewer", "ip": ip_of(websocket.scope)}
    gate.connected += 1
    try:
        logger.info("viewer: %s connected as %s (%d in all)", fields["ip"], viewer.value, gate.connected, extra=fields)
        await _forward(websocket, gate.host, viewer, token_ended)
    except (OSError, InvalidHandshake) as error:
        logger.warning("viewer: its process does not answer: %s", error, extra=fields)
        await websocket.close(UNAVAILABLE)
    finally:
        gate.connected -= 1
        logger.info("viewer: %s disconnected", fields["ip"], extra=fields)


def _refuse_other_pages(connection: HTTPConnection) -> None:
    """Refuse requests of other pages: only our own may act for its user."""
    origin = connection.headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != connection.headers.get("host"):
        raise Refusal(403, "viewer: expected a request of the master's own page, got one of another")


async def _forward(websocket: WebSocket, host: ViewerHost, viewer: Viewer, token_ended: asyncio.Event) -> None:
    async with connect(
        f"ws://127.0.0.1:{host.port}/",
        subprotocols=websocket.scope["subprotocols"] or None,
        additional_headers={"Authorization": f"Bearer {host.key}", "Cellwatch-Viewer": viewer.value},
        # A slow browser blocks the process, not a buffer here: viser then sends only the newest.
        max_queue=1,
        max_size=MESSAGE_MAX_BYTES,
        compression=None,
        ping_interval=None,
        proxy=None,
    ) as inner:
        await websocket.accept(inner.subprotocol)
        both_ways = _up(websocket, inner), _down(websocket, inner)
        await serve(websocket, token_ended, *both_ways, gone=(ConnectionClosed,))


async def _up(websocket: WebSocket, inner: ClientConnection) -> None:
    while True:
        data = await websocket.receive_bytes()
        if is_passed(data):
            await inner.send(data)
        else:
            logger.debug("viewer: a message that is no action of a user was dropped")


async def _down(websocket: WebSocket, inner: ClientConnection) -> None:
    async for data in inner:
        assert isinstance(data, bytes)
        await websocket.send_bytes(data)
    await websocket.close(UNAVAILABLE)


def is_passed(data: bytes) -> bool:
    """Return True if a message of a browser may reach the viewer's process."""
    try:
        message = msgpack.unpackb(data)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
        return False
    kind = message.get("type") if isinstance(message, dict) else None
    if not isinstance(kind, str) or kind not in PASSED:
        return False
    updates = message.get("updates", {})
    return isinstance(updates, dict) and set(updates) <= CHANGED
