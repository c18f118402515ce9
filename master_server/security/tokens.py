# SPDX-License-Identifier: Apache-2.0
"""The files of the two tokens: made at the first start, read again while the master runs, replaced on request.

Only the master's user can read them, and their content is never logged.
"""

from __future__ import annotations

import logging
import os
import secrets
import stat
from enum import Enum
from pathlib import Path

from shared.errors import ConfigError
from shared.files import write_private

logger = logging.getLogger(__name__)

TOKEN_BYTES = 32
"""256 bits of randomness: impossible to guess at any rate."""

TOKEN_MIN_CHARS = 16
"""A shorter one is an accident with an editor, not a token."""

TOKEN_MAX_CHARS = 256
"""Longer than any token; bounds the comparison."""

FILE_MAX_BYTES = 4096
"""Bytes read from a file; a longer file is no token."""

OTHERS = stat.S_IRWXG | stat.S_IRWXO


class Role(Enum):
    """The two users of the API; each has a token."""

    UNIT = "unit"
    OPERATOR = "operator"


def token_file(state_dir: Path, role: Role) -> Path:
    """Return the path of a role's token."""
    return state_dir / f"{role.value}.token"


def read_token(state_dir: Path, role: Role) -> bytes:
    """Read the token of a role; if others can read the file, restrict its mode.

    Raises:
        ConfigError: the file cannot be read or restricted, or holds no token.
    """
    path = token_file(state_dir, role)
    try:
        # A pipe at this path must not block.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if os.fstat(file.fileno()).st_mode & OTHERS:
                logger.warning("%s was readable by others: its mode is now 0600", path)
                os.fchmod(file.fileno(), 0o600)
            token = file.read(FILE_MAX_BYTES).strip()
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot read the {role.value} token, or set its mode to 0600: {error.strerror}"
        ) from error
    if not TOKEN_MIN_CHARS <= len(token) <= TOKEN_MAX_CHARS or not all(33 <= byte <= 126 for byte in token):
        raise ConfigError(
            f"{path}: expected a token of {TOKEN_MIN_CHARS} to {TOKEN_MAX_CHARS} ASCII characters in one line, "
            f"got {len(token)} bytes of something else; `master-server new-token {role.value}` makes a new one"
        )
    return token


def make_missing(state_dir: Path) -> None:
    """Make the folder and each missing token.

    Raises:
        ConfigError: the folder or a file cannot be made.
    """
    try:
        state_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ConfigError(f"{state_dir}: cannot make the folder for tokens: {error.strerror}") from error
    for role in Role:
        if not os.path.lexists(token_file(state_dir, role)):
            logger.info("made the %s token in %s", role.value, write_token(state_dir, role))


def write_token(state_dir: Path, role: Role) -> Path:
    """Write a new token, replacing an old one; return its path.

    The file belongs to the owner of the folder, since that user runs the master.

    Raises:
        ConfigError: the folder is missing or another user's, or the file cannot be written; the old token stays.
    """
    path = token_file(state_dir, role)
    try:
        folder = state_dir.stat()
        user = os.geteuid()
        if user not in (0, folder.st_uid):
            raise ConfigError(
                f"{state_dir}: expected its owner (user number {folder.st_uid}) or root to run this, "
                f"got user number {user}: the master could not read the token"
            )
        owner = (folder.st_uid, folder.st_gid) if user == 0 else None
        write_private(path, f"{secrets.token_urlsafe(TOKEN_BYTES)}\n".encode(), owner)
    except OSError as error:
        raise ConfigError(f"{path}: cannot write the {role.value} token: {error.strerror}") from error
    return path
