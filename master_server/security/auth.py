# SPDX-License-Identifier: Apache-2.0
"""Access control: one token for units and one for operators, each valid while its file holds it."""

from __future__ import annotations

import asyncio
import hmac
import logging
from dataclasses import dataclass, field
from pathlib import Path

from master_server.security.tokens import TOKEN_MAX_CHARS, Role, make_missing, read_token, token_file
from shared.errors import ConfigError, Refusal

logger = logging.getLogger(__name__)

READ_EVERY_S = 0.1
"""Period of reading the tokens' files: an operator who replaces a token wants the old one refused soon. It takes 50 us
in a thread and delays no request."""

UNITS = frozenset({Role.UNIT})
OPERATORS = frozenset({Role.OPERATOR})
ANYONE = frozenset({Role.UNIT, Role.OPERATOR})


@dataclass
class Access:
    """The two tokens, and whether reading needs one.

    Attributes:
        state_dir: the folder with the files of the tokens, for `follow`.
    """

    unit_token: bytes = field(repr=False)
    operator_token: bytes = field(repr=False)
    public_reads: bool = False
    state_dir: Path | None = None
    _ends: dict[Role, asyncio.Event] = field(
        default_factory=lambda: {role: asyncio.Event() for role in Role}, init=False, repr=False, compare=False
    )

    def check(self, authorization: bytes | None, allowed: frozenset[Role]) -> Role:
        """Return the role of a request with this `Authorization` header.

        Raises:
            Refusal: 401 without a valid token, 403 with one of another role.
        """
        if authorization is None:
            raise Refusal(401, "no token: expected the header 'Authorization: Bearer <token>'")
        scheme, _, token = authorization[: TOKEN_MAX_CHARS + 8].partition(b" ")
        if scheme.lower() != b"bearer":
            raise Refusal(401, "no bearer token: expected the header 'Authorization: Bearer <token>'")
        token = token.strip()
        # Compare with both, each in constant time, so that timing reveals nothing about either.
        is_unit = hmac.compare_digest(token, self.unit_token)
        is_operator = hmac.compare_digest(token, self.operator_token)
        if not (is_unit or is_operator):
            raise Refusal(401, "unknown token: it is neither the unit's nor the operator's of this master")
        role = Role.UNIT if is_unit else Role.OPERATOR
        if role not in allowed:
            wanted = " or ".join(sorted(one.value for one in allowed))
            raise Refusal(403, f"this needs the token of the {wanted}, got that of the {role.value}")
        return role

    def check_read(self, authorization: bytes | None) -> None:
        """Raise a Refusal (401) unless this request may read."""
        if not self.public_reads:
            self.check(authorization, ANYONE)

    def token_of(self, role: Role) -> bytes:
        """Return the current token of a role."""
        return self.unit_token if role is Role.UNIT else self.operator_token

    def end_of(self, role: Role) -> asyncio.Event:
        """Return an event that is set once the current token of this role is replaced."""
        return self._ends[role]

    def replace(self, role: Role, token: bytes) -> None:
        """Replace the token of the role; the old one is refused."""
        if role is Role.UNIT:
            self.unit_token = token
        else:
            self.operator_token = token
        ended, self._ends[role] = self._ends[role], asyncio.Event()
        ended.set()

    async def follow(self) -> None:
        """Apply each replaced token file, until cancelled.

        While a file is missing or holds no token, the old token stays valid.
        """
        if self.state_dir is None:
            return
        seen: dict[Role, str] = {}
        warned: dict[Role, str] = {}
        while True:
            await asyncio.sleep(READ_EVERY_S)
            for role, found in (await asyncio.to_thread(_read_files, self.state_dir)).items():
                if isinstance(found, bytes):
                    seen.pop(role, None)
                    warned.pop(role, None)
                    if found != self.token_of(role):
                        self.replace(role, found)
                        logger.info(
                            "%s was replaced: the old token is refused from now on",
                            token_file(self.state_dir, role),
                            extra={"event": "token"},
                        )
                    continue
                trouble = str(found)
                # Warn only at the second read: an editor that writes a file in place empties it first.
                if seen.get(role) == trouble and warned.get(role) != trouble:
                    logger.warning("%s; the old token stays valid", trouble, extra={"event": "token"})
                    warned[role] = trouble
                seen[role] = trouble


def load_access(state_dir: Path, public_reads: bool) -> Access:
    """Read the tokens in `state_dir`; make missing ones.

    Raises:
        ConfigError: the folder or a file cannot be read or written, or a file holds no token.
    """
    make_missing(state_dir)
    return Access(read_token(state_dir, Role.UNIT), read_token(state_dir, Role.OPERATOR), public_reads, state_dir)


def _read_files(state_dir: Path) -> dict[Role, bytes | ConfigError]:
    """Return the tokens in the files now, or the error for each file."""
    found: dict[Role, bytes | ConfigError] = {}
    for role in Role:
        try:
            found[role] = read_token(state_dir, role)
        except ConfigError as error:
            found[role] = error
    return found
