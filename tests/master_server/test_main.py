# SPDX-License-Identifier: Apache-2.0
"""Failures of the command line; tests/system runs it successfully."""

from __future__ import annotations

import logging
import socket
from pathlib import Path

import pytest

from master_server.__main__ import main

CELL = "name: c\nbox: {min: [0, 0, 0], max: [1, 1, 1]}\n"


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a failing command and return its one line on standard error."""
    assert main(arguments) == 1
    line = capsys.readouterr().err
    assert line.startswith("master-server: ")
    assert line.count("\n") == 1
    return line


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(CELL)
    return path


def test_a_missing_option_for_the_cell_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert "cell: field required" in run(capsys)


def test_a_missing_cell_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert "gone.yaml" in run(capsys, "--cell", str(tmp_path / "gone.yaml"), "--state-dir", str(tmp_path))


def test_a_wrong_setting_is_named(capsys: pytest.CaptureFixture[str], cell: Path) -> None:
    line = run(capsys, "--cell", str(cell), "--set", "settings.voxel_size_m=7")
    assert "settings.voxel_size_m" in line
    assert "got 7" in line


def test_a_wrong_variable_is_named(
    capsys: pytest.CaptureFixture[str], cell: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CELLWATCH_MASTER_PORT", "100000")
    assert "port" in run(capsys, "--cell", str(cell))


def test_a_port_that_is_taken_is_named(capsys: pytest.CaptureFixture[str], cell: Path, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        options = ("--cell", str(cell), "--host", "127.0.0.1", "--port", port, "--state-dir", str(tmp_path / "state"))
        assert f"127.0.0.1 port {port}" in run(capsys, *options)


def test_a_state_folder_that_cannot_be_made_is_named(
    capsys: pytest.CaptureFixture[str], cell: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    state_dir = tmp_path / "file" / "state"
    assert str(state_dir) in run(capsys, "--cell", str(cell), "--state-dir", str(state_dir))


def test_only_the_file_of_a_new_token_is_printed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    for role in ("unit", "operator"):
        assert main(("new-token", role, "--state-dir", str(tmp_path))) == 0
        path = tmp_path / f"{role}.token"
        printed = "".join(capsys.readouterr()) + caplog.text
        assert f"the new token of the {role} is in {path}" in printed
        assert path.read_text().strip() not in printed


def test_a_new_token_without_a_folder_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert "gone/unit.token" in run(capsys, "new-token", "unit", "--state-dir", str(tmp_path / "gone"))
    with pytest.raises(SystemExit):
        main(("new-token", "unit"))
    with pytest.raises(SystemExit):
        main(("new-token", "everyone", "--state-dir", str(tmp_path)))
    assert list(tmp_path.iterdir()) == []
