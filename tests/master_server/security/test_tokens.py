# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest

from master_server.security import Role, load_access, token_file, write_token
from master_server.security.tokens import read_token
from shared.errors import ConfigError

OTHER_USER, OTHER_GROUP = 12345, 23456


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


def test_a_new_token_is_another_one_whole_and_for_nobody_else(tmp_path: Path) -> None:
    before = load_access(tmp_path, False)
    # A left-over of a power cut during an earlier attempt.
    (tmp_path / "unit.partial").write_text("half")
    assert write_token(tmp_path, Role.UNIT) == token_file(tmp_path, Role.UNIT)
    after = load_access(tmp_path, False)
    assert len(after.unit_token) >= 43
    assert after.unit_token != before.unit_token
    assert after.operator_token == before.operator_token
    assert sorted(path.name for path in tmp_path.iterdir()) == ["operator.token", "unit.token"]
    assert token_file(tmp_path, Role.UNIT).stat().st_mode & 0o777 == 0o600


def test_a_token_that_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = load_access(tmp_path, False)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(ConfigError, match=r"unit\.token: cannot write the unit token: No space"):
            write_token(tmp_path, Role.UNIT)
    assert load_access(tmp_path, False) == before
    assert not (tmp_path / "unit.partial").exists()


def test_a_folder_that_is_not_there_is_not_made_for_a_new_token(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone/unit\.token: cannot write"):
        write_token(tmp_path / "gone", Role.UNIT)
    assert not (tmp_path / "gone").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give files away")
def test_a_token_written_by_root_belongs_to_the_owner_of_the_folder(tmp_path: Path) -> None:
    state_dir = tmp_path / "state"
    state_dir.mkdir(mode=0o700)
    os.chown(state_dir, OTHER_USER, OTHER_GROUP)
    found = write_token(state_dir, Role.OPERATOR).stat()
    assert (found.st_uid, found.st_gid, found.st_mode & 0o777) == (OTHER_USER, OTHER_GROUP, 0o600)


def test_another_user_cannot_write_an_unreadable_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: OTHER_USER)
    with pytest.raises(ConfigError, match=f"got user number {OTHER_USER}"):
        write_token(tmp_path, Role.UNIT)
    assert list(tmp_path.iterdir()) == []


def test_a_token_file_that_others_can_read_is_restricted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    load_access(tmp_path, False)
    token_file(tmp_path, Role.UNIT).chmod(0o644)
    load_access(tmp_path, False)
    assert token_file(tmp_path, Role.UNIT).stat().st_mode & 0o777 == 0o600
    assert "was readable by others" in caplog.text


@pytest.mark.parametrize("text", ["", "short", "x" * 1000, "ä" * 30, "two words 0123456789", "x" * 10**6])
def test_a_file_without_a_token_is_refused(tmp_path: Path, text: str) -> None:
    token_file(tmp_path, Role.UNIT).write_text(text)
    with pytest.raises(ConfigError, match=r"unit\.token: expected a token.*new-token unit"):
        load_access(tmp_path, False)


def test_a_pipe_or_a_folder_in_its_place_is_refused(tmp_path: Path) -> None:
    os.mkfifo(token_file(tmp_path, Role.UNIT), 0o600)
    token_file(tmp_path, Role.OPERATOR).mkdir(mode=0o700)
    with pytest.raises(ConfigError, match="expected a token"):
        read_token(tmp_path, Role.UNIT)
    with pytest.raises(ConfigError, match="cannot read"):
        read_token(tmp_path, Role.OPERATOR)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="file/state"):
        load_access(tmp_path / "file" / "state", False)
