# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import SecretStr

from edge_unit.config import ENVIRONMENT_PREFIX, PoseConfig, UnitConfig
from edge_unit.sources.recorded import RecordedSourceConfig, read_pose
from edge_unit.sources.simulated import SimulatedSourceConfig
from shared.configuration import load
from shared.errors import ConfigError, InputError
from shared.transforms import from_xyz_rpy

FILE = """
source: {kind: recorded, folder: /data, fps: 15}
master_url: http://10.0.0.2:8420
token_file: /etc/token
T_world_camera: {xyz: [1, 2, 3], rpy_deg: [0, 90, 0]}
"""


def read(tmp_path: Path, text: str, environment: dict[str, str] | None = None, **overrides: Any) -> UnitConfig:
    path = tmp_path / "unit.yaml"
    path.write_text(text)
    return load(UnitConfig, path, environment or {}, ENVIRONMENT_PREFIX, overrides)


def test_a_file_is_enough(tmp_path: Path) -> None:
    config = read(tmp_path, FILE)
    assert isinstance(config.source, RecordedSourceConfig)
    assert config.source.fps == 15.0
    assert config.T_world_camera is not None
    assert np.allclose(config.T_world_camera.transform(), from_xyz_rpy((1, 2, 3), (0, np.pi / 2, 0)))


def test_no_file_is_needed() -> None:
    environment = {"CELLWATCH_UNIT_SOURCE__KIND": "simulated", "CELLWATCH_UNIT_SOURCE__CAMERA": "3"}
    config = load(UnitConfig, None, environment, ENVIRONMENT_PREFIX, {"master_url": "http://master:1"})
    assert config.source == SimulatedSourceConfig(camera=3)
    assert config.master_url == "http://master:1"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("master_url: ftp://x", "master_url"),
        ("master_url: 10.0.0.2:8420", "master_url"),
        ("master_url: http://x/path", "master_url"),
        ("source_address: 300.0.0.1", "source_address"),
        ("token: abc", "expected token or token_file, got both"),
        ("T_world_camera: {xyz: [1, 2]}", "T_world_camera.xyz"),
        ("T_world_camera: {}", "expected one of xyz"),
        ("T_world_camera: {xyz: [1, 2, 3], file: a}", "expected one of xyz"),
        ("learn_background_frames: -1", "learn_background_frames"),
        ("fps_max: 0", "fps_max"),
        ("source: {kind: telescope}", "source"),
        ("source: {kind: recorded}", "folder: field required"),
        ("fps: 1", "fps: extra inputs"),
    ],
)
def test_an_error_names_the_value(tmp_path: Path, line: str, words: str) -> None:
    name = line.split(":")[0]
    kept = [one for one in FILE.strip().splitlines() if not one.startswith(f"{name}:")]
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, "\n".join([*kept, line]))
    assert words in str(caught.value)
    assert "unit.yaml" in str(caught.value)


def test_the_token_is_never_printed(tmp_path: Path) -> None:
    config = UnitConfig(source=SimulatedSourceConfig(), token=SecretStr("secret-0123456789"))
    assert "secret" not in repr(config)
    assert config.read_token() == "secret-0123456789"


def test_a_token_file_is_read_anew_each_time(tmp_path: Path) -> None:
    path = tmp_path / "token"
    config = UnitConfig(source=SimulatedSourceConfig(), token_file=path)
    with pytest.raises(ConfigError, match=r"token_file .*cannot be read"):
        config.read_token()
    for text in ("one\n", "two"):
        path.write_text(text)
        assert config.read_token() == text.strip()
    for text in ("\n", "one\ntwo", "a\x00b"):
        path.write_text(text)
        with pytest.raises(ConfigError, match="in one line of plain characters"):
            config.read_token()


def test_without_a_token_it_says_so() -> None:
    with pytest.raises(ConfigError, match="expected token or token_file"):
        UnitConfig(source=SimulatedSourceConfig()).read_token()


def test_a_pose_as_a_matrix_or_a_file(tmp_path: Path) -> None:
    wanted = from_xyz_rpy((1, 2, 3), (0.1, 0.2, 0.3))
    assert np.allclose(PoseConfig(matrix=wanted.tolist()).transform(), wanted)
    np.savetxt(tmp_path / "pose.txt", wanted)
    assert np.allclose(PoseConfig(file=tmp_path / "pose.txt").transform(), wanted)
    with pytest.raises(InputError, match=r"T_world_camera\.matrix"):
        PoseConfig(matrix=((1.0, 0.0, 0.0, 0.0),) * 4).transform()


@pytest.mark.parametrize("text", ["", "1 2 3 4", "a b", "2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1"])
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_a_pose_file_that_holds_none_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "pose.txt"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"pose\.txt"):
        read_pose(path)


def test_state_lies_in_the_service_managers_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    config = UnitConfig(source=SimulatedSourceConfig())
    assert config.state_dir == tmp_path / "cellwatch" / "edge-unit"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/a")
    assert UnitConfig(source=SimulatedSourceConfig()).state_dir == Path("/var/lib/a")
