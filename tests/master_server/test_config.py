# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from master_server.config import MasterConfig


def test_the_state_folder_is_that_of_the_service_manager(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert MasterConfig(cell=Path("cell.yaml")).state_dir == tmp_path / "cellwatch" / "master"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/a:/var/lib/b")
    assert MasterConfig(cell=Path("cell.yaml")).state_dir == Path("/var/lib/a")


def test_reads_are_not_public_by_default() -> None:
    assert not MasterConfig(cell=Path("cell.yaml")).public_reads
