# SPDX-License-Identifier: Apache-2.0
"""Access to the viewer: links that work once, and cookies.

A browser sends no `Authorization` header by itself, and a token in an address ends up in histories and logs. So a link
carries a code that works once, behind the `#`, which browsers do not send. The page sends the code and receives a
cookie. The cookie is signed with the token that it stands for. It outlives a restart of the master, and is void as soon
as that token is replaced, as are links that were not opened yet.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from enum import Enum

from master_server.security import Access, Role
from shared.clock import NS_PER_S
from shared.errors import Refusal

LINK_S = 600
"""A link is meant to be opened at once; one that is left in a terminal or a log has expired."""

LINKS_MAX = 16
"""Links that were made and not opened; beyond, the oldest is void."""

CODE_BYTES = 32

SESSION_S = 12 * 3600
"""A long shift; after it the operator needs a new link."""

COOKIE_MAX_CHARS = 256
"""Largest cookie, about three times the size of ours."""


class Viewer(str, Enum):
    """The rights of a user of the viewer."""

    READER = "reader"
    OPERATOR = "operator"


SIGNED_WITH = {Viewer.READER: Role.UNIT, Viewer.OPERATOR: Role.OPERATOR}


def viewer_of(role: Role) -> Viewer:
    """Return the rights of a token's holder: the units' token may only view."""
    return Viewer.OPERATOR if role is Role.OPERATOR else Viewer.READER


class Sessions:
    """The links of one master and the cookies that they are exchanged for."""

    def __init__(self, access: Access) -> None:
        self._access = access
        self._links: dict[str, int] = {}

    def make_code(self, now_ns: int) -> str:
        """Return the code of a link, which makes its opener an operator once."""
        while len(self._links) >= LINKS_MAX:
            del self._links[next(iter(self._links))]
        code = secrets.token_urlsafe(CODE_BYTES)
        self._links[self._digest(code)] = now_ns + LINK_S * NS_PER_S
        return code

    def redeem(self, code: str, now_ns: int) -> Viewer:
        """Return the rights of the link with this code, and void the code.

        Raises:
            Refusal: 401, there is no such link, it was used before, or it has expired.
        """
        expires_at_ns = self._links.pop(self._digest(code), None)
        if expires_at_ns is None or expires_at_ns <= now_ns:
            raise Refusal(401, f"link: expected one that was not opened yet and is at most {LINK_S // 60} minutes old")
        return Viewer.OPERATOR

    def cookie(self, viewer: Viewer, wall_ns: int) -> str:
        """Return the value of a cookie that is valid for `SESSION_S`."""
        # By the wall clock: the monotonic one restarts with the machine, and a cookie may outlive that.
        expires_s = wall_ns // NS_PER_S + SESSION_S
        return f"{viewer.value}.{expires_s}.{self._signature(viewer, expires_s)}"

    def viewer(self, cookie: str, wall_ns: int) -> Viewer | None:
        """Return the rights of a cookie; None for a forged or expired one."""
        parts = cookie[:COOKIE_MAX_CHARS].split(".")
        if len(parts) != 3 or not cookie.isascii():
            return None
        name, expires, signature = parts
        viewer = next((one for one in Viewer if one.value == name), None)
        if viewer is None or not expires.isdigit() or len(expires) > 12:
            return None
        if not hmac.compare_digest(signature, self._signature(viewer, int(expires))):
            return None
        return viewer if int(expires) * NS_PER_S > wall_ns else None

    def _signature(self, viewer: Viewer, expires_s: int) -> str:
        is_operators = SIGNED_WITH[viewer] is Role.OPERATOR
        key = self._access.operator_token if is_operators else self._access.unit_token
        return hmac.new(key, f"cellwatch viewer {viewer.value} {expires_s}".encode(), hashlib.sha256).hexdigest()

    def _digest(self, code: str) -> str:
        """Return the key under which a code is stored: its timing reveals nothing, and it changes with the token."""
        return hmac.new(self._access.operator_token, code.encode("utf-8", "surrogatepass"), hashlib.sha256).hexdigest()
