# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import logging
from pathlib import Path

import pytest

from master_server.access import ANYONE, OPERATORS, UNITS, Access, Role, load_access, token_file
from shared.errors import ConfigError, Refusal

ACCESS = Access(b"unit-token-0123456789", b"operator-token-0123456789")


def bearer(token: bytes) -> bytes:
    return b"Bearer " + token


def test_each_token_opens_its_own_doors() -> None:
    assert ACCESS.check(bearer(ACCESS.unit_token), UNITS) is Role.UNIT
    assert ACCESS.check(bearer(ACCESS.operator_token), OPERATORS) is Role.OPERATOR
    assert ACCESS.check(b"bearer  " + ACCESS.unit_token + b" ", ANYONE) is Role.UNIT


@pytest.mark.parametrize(
    ("header", "allowed", "status", "words"),
    [
        (None, ANYONE, 401, "no token"),
        (b"", ANYONE, 401, "no bearer token"),
        (b"Basic abc", ANYONE, 401, "no bearer token"),
        (b"Bearer", ANYONE, 401, "unknown token"),
        (b"Bearer nonsense", ANYONE, 401, "unknown token"),
        (b"Bearer " + b"x" * 100_000, ANYONE, 401, "unknown token"),
        (b"Bearer " + ACCESS.unit_token[:-1], ANYONE, 401, "unknown token"),
        (b"Bearer \xff\xfe", ANYONE, 401, "unknown token"),
        (bearer(ACCESS.unit_token), OPERATORS, 403, "token of the operator, got that of the unit"),
        (bearer(ACCESS.operator_token), UNITS, 403, "token of the unit, got that of the operator"),
    ],
)
def test_refusals(header: bytes | None, allowed: frozenset[Role], status: int, words: str) -> None:
    with pytest.raises(Refusal, match=words) as caught:
        ACCESS.check(header, allowed)
    assert caught.value.status == status


def test_reading_needs_a_token_unless_it_is_public() -> None:
    ACCESS.check_read(bearer(ACCESS.unit_token))
    with pytest.raises(Refusal):
        ACCESS.check_read(None)
    Access(b"a" * 20, b"b" * 20, public_reads=True).check_read(None)


def test_tokens_are_made_once_for_nobody_else_and_never_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    state_dir = tmp_path / "state"
    first = load_access(state_dir, False)
    assert first == load_access(state_dir, False)
    assert first.unit_token != first.operator_token
    assert len(first.unit_token) >= 43
    for role in Role:
        assert token_file(state_dir, role).stat().st_mode & 0o777 == 0o600
    assert str(token_file(state_dir, Role.UNIT)) in caplog.text
    assert first.unit_token.decode() not in caplog.text
    assert first.operator_token.decode() not in caplog.text


def test_a_token_file_that_others_can_read_is_closed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    load_access(tmp_path, False)
    token_file(tmp_path, Role.UNIT).chmod(0o644)
    load_access(tmp_path, False)
    assert token_file(tmp_path, Role.UNIT).stat().st_mode & 0o777 == 0o600
    assert "can be read by others" in caplog.text


@pytest.mark.parametrize("text", ["", "short", "x" * 1000, "ä" * 30])
def test_a_file_without_a_token_is_refused(tmp_path: Path, text: str) -> None:
    token_file(tmp_path, Role.UNIT).write_text(text)
    with pytest.raises(ConfigError, match=r"unit\.token: expected a token"):
        load_access(tmp_path, False)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="file/state"):
        load_access(tmp_path / "file" / "state", False)
