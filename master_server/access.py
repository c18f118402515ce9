# SPDX-License-Identifier: Apache-2.0
"""Who may do what: one token for units, one for operators.

Both are made at the first start, kept in files that only the master's user can read, and never logged.
"""

from __future__ import annotations

import hmac
import logging
import os
import secrets
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from shared.errors import ConfigError, Refusal

logger = logging.getLogger(__name__)

TOKEN_BYTES = 32
"""256 bits of randomness: nobody guesses it, whatever the rate."""

TOKEN_MIN_CHARS = 16
"""Shorter is an accident with an editor, not a token."""

TOKEN_MAX_CHARS = 256
"""Longer than any token; bounds what is compared."""


class Role(Enum):
    """Whose token it is."""

    UNIT = "unit"
    OPERATOR = "operator"


UNITS = frozenset({Role.UNIT})
OPERATORS = frozenset({Role.OPERATOR})
ANYONE = frozenset({Role.UNIT, Role.OPERATOR})


@dataclass(frozen=True)
class Access:
    """The two tokens, and whether reading needs one at all."""

    unit_token: bytes
    operator_token: bytes
    public_reads: bool = False

    def check(self, authorization: bytes | None, allowed: frozenset[Role]) -> Role:
        """The role of a request with this `Authorization` header.

        Raises:
            Refusal: 401 without a valid token, 403 with one of another role.
        """
        if authorization is None:
            raise Refusal(401, "no token: expected the header 'Authorization: Bearer <token>'")
        scheme, _, token = authorization[: TOKEN_MAX_CHARS + 8].partition(b" ")
        if scheme.lower() != b"bearer":
            raise Refusal(401, "no bearer token: expected the header 'Authorization: Bearer <token>'")
        token = token.strip()
        # Both are compared, each in constant time, so that timing tells nothing about either.
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


def token_file(state_dir: Path, role: Role) -> Path:
    """Where the token of a role lies."""
    return state_dir / f"{role.value}.token"


def load_access(state_dir: Path, public_reads: bool) -> Access:
    """Read the tokens in `state_dir`; make what is missing.

    Raises:
        ConfigError: the folder or a file cannot be read or written, or a file holds no token.
    """
    try:
        state_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ConfigError(f"{state_dir}: cannot make the folder for tokens: {error.strerror}") from error
    return Access(_token(state_dir, Role.UNIT), _token(state_dir, Role.OPERATOR), public_reads)


def _token(state_dir: Path, role: Role) -> bytes:
    path = token_file(state_dir, role)
    try:
        if not path.exists():
            _write_private(path, secrets.token_urlsafe(TOKEN_BYTES))
            logger.info("made the %s token in %s", role.value, path)
        elif path.stat().st_mode & 0o077:
            logger.warning("%s can be read by others: closing it (mode 0600)", path)
            path.chmod(0o600)
        token = path.read_bytes().strip()
    except OSError as error:
        raise ConfigError(f"{path}: cannot read or make the {role.value} token: {error.strerror}") from error
    if not TOKEN_MIN_CHARS <= len(token) <= TOKEN_MAX_CHARS or not token.isascii():
        raise ConfigError(
            f"{path}: expected a token of {TOKEN_MIN_CHARS} to {TOKEN_MAX_CHARS} ASCII characters, "
            f"got {len(token)} bytes; delete the file to have a new one made"
        )
    return token


def _write_private(path: Path, text: str) -> None:
    """Write whole or not at all, readable by nobody else at any moment."""
    partial = path.with_suffix(".partial")
    partial.unlink(missing_ok=True)
    with os.fdopen(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text + "\n")
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
