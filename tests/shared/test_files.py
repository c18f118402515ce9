# SPDX-License-Identifier: Apache-2.0
"""Atomic writes and state files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from shared.files import STATE_MAX_BYTES, StateFile, write_private, write_whole


@pytest.mark.parametrize("synced", [True, False])
def test_a_file_is_replaced_atomically(tmp_path: Path, synced: bool) -> None:
    path = tmp_path / "state.json"
    (tmp_path / "state.partial").write_text("half")
    for content in (b"one", b"another"):
        write_whole(path, content, synced=synced)
        assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_only_private_files_are_unreadable_by_others(tmp_path: Path) -> None:
    mask = os.umask(0o022)
    try:
        write_whole(tmp_path / "open", b"")
        write_private(tmp_path / "closed", b"")
    finally:
        os.umask(mask)
    assert (tmp_path / "open").stat().st_mode & 0o777 == 0o644
    assert (tmp_path / "closed").stat().st_mode & 0o777 == 0o600


def test_a_failed_write_keeps_the_old_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_whole(tmp_path / "file", b"one")

    def full(_: int) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space left"):
        write_whole(tmp_path / "file", b"another")
    assert (tmp_path / "file").read_bytes() == b"one"
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_state_is_stored_and_equal_state_is_not_written_again(tmp_path: Path) -> None:
    file = StateFile(tmp_path / "new" / "state.json")
    assert file.load(dict) is None
    file.save({"a": 1})
    assert file.load(dict) == {"a": 1}
    written_ns = (tmp_path / "new" / "state.json").stat().st_mtime_ns
    file.save({"a": 1})
    assert (tmp_path / "new" / "state.json").stat().st_mtime_ns == written_ns
    file.save({"a": 2})
    assert file.load(dict) == {"a": 2}
    file.drop()
    assert file.load(dict) is None


def parse(document: Any) -> int:
    return int(document["a"])


@pytest.mark.parametrize(
    "content",
    [b"", b"\xff", b"[]", b"{}", b'{"a": "b"}', b"[" * (STATE_MAX_BYTES - 1), b" " * STATE_MAX_BYTES + b'{"a": 1}'],
    ids=["empty", "no text", "no map", "no a", "no number", "deep", "long"],
)
def test_a_damaged_document_is_ignored_with_a_warning(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(content)
    assert StateFile(path).load(parse) is None
    assert f"{path}: ignored, since it cannot be read: " in caplog.text


def test_a_failed_save_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("a file where a folder should be")
    StateFile(tmp_path / "file" / "state.json").save({})
    assert "state.json: cannot be written" in caplog.text
