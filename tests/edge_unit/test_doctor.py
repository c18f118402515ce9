# SPDX-License-Identifier: Apache-2.0
"""The doctor's findings: right, and each with its remedy."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from edge_unit import __main__ as command_line
from edge_unit import doctor
from edge_unit.config import UnitConfig
from edge_unit.doctor import Finding, Measured, examine
from edge_unit.sources.frame import CameraInfo
from edge_unit.sources.realsense.source import RealsenseSourceConfig
from shared.camera import Intrinsics
from shared.clock import NS_PER_S
from tests.edge_unit.sources.realsense import recordings

INFO = CameraInfo("1", "D435", Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5))
NO_MASTER = "http://127.0.0.1:9"


def measured(fps: float, valid: float = 0.8, count: int = 45) -> Measured:
    depth = np.zeros(48 * 64, np.uint16)
    depth[: round(valid * depth.size)] = 1000
    stamps = [round(number * NS_PER_S / fps) for number in range(count)]
    return Measured(list(range(count)), stamps, [30.0] * count, [depth.reshape(48, 64)])


def only(findings: Sequence[Finding], what: str) -> Finding:
    return next(finding for finding in findings if finding.what == what)


@pytest.mark.parametrize(("fps", "level"), [(30.0, "ok"), (28.0, "ok"), (20.0, "warning"), (10.0, "FAIL")])
def test_the_rate_is_held_against_the_wanted_one(fps: float, level: str) -> None:
    found = only(list(doctor.stream(INFO, measured(fps), 30.0)), "stream")
    assert found.level == level
    assert f"64x48 at {fps:.1f} fps" in found.text
    assert ("more light" in found.text) == (level != "ok")


def test_without_a_configured_rate_any_rate_is_ok() -> None:
    assert only(list(doctor.stream(INFO, measured(2.0), None)), "stream").level == "ok"


def test_a_covered_lens_is_a_warning() -> None:
    found = only(list(doctor.stream(INFO, measured(15.0, valid=0.1), 15.0)), "depth")
    assert (found.level, found.text) == (
        "warning",
        "only 10% of the pixels measure anything; is the lens free and the cell lit?",
    )


def test_no_frames_fail() -> None:
    (found,) = doctor.stream(INFO, Measured(), 15.0)
    assert (found.level, found.text) == ("FAIL", "D435 1 was opened and delivered no frames")


@pytest.mark.parametrize(
    ("wall_s", "is_set", "level"),
    [(0, True, "warning"), (1_800_000_000, False, "warning"), (1_800_000_000, True, "ok")],
)
def test_the_wall_clock(monkeypatch: pytest.MonkeyPatch, wall_s: int, is_set: bool, level: str) -> None:
    monkeypatch.setattr(doctor, "wall_ns", lambda: wall_s * NS_PER_S)
    monkeypatch.setattr(doctor, "clock_is_set", lambda: is_set)
    assert doctor.clock().level == level


async def test_without_master_and_camera_it_gives_the_remedies() -> None:
    config = UnitConfig(source=RealsenseSourceConfig(), master_url=NO_MASTER, token="secret")
    findings = [finding async for finding in examine(config)]
    master, camera = only(findings, "master"), only(findings, "camera")
    assert master.level == "FAIL"
    assert "is it running, and is master_url right?" in master.text
    assert camera.level == "FAIL"
    assert "play a recording (source.recording) or simulate (source.kind: simulated)" in camera.text
    assert "secret" not in "".join(map(str, findings))
    # It does not wait for an absent camera.
    assert findings[-1] is camera


async def test_an_absent_serial_is_named() -> None:
    config = UnitConfig(source=RealsenseSourceConfig(serial="42"), master_url=NO_MASTER)
    findings = [finding async for finding in examine(config)]
    assert only(findings, "token").text.startswith(
        "token: expected token or token_file in the configuration, got neither"
    )
    assert only(findings, "camera").text == "source.serial is 42, and there is none: correct it, or plug it in"


async def test_with_a_recording_all_but_the_master_is_checked(tmp_path: Path) -> None:
    recording = await asyncio.to_thread(recordings.write, tmp_path / "camera.db3", 30, usb=2.1)
    source = RealsenseSourceConfig(recording=recording, loop=True)
    config = UnitConfig(source=source, master_url=NO_MASTER, token="x")
    levels = {finding.what: finding.level async for finding in examine(config, 0.5)}
    levels.pop("clock")
    assert levels == {
        "software": "ok",
        "network": "ok",
        "master": "FAIL",
        "sdk": "ok",
        "camera": "ok",
        "profile": "warning",
        "stream": "ok",
        "depth": "ok",
        "kernels": "ok",
        "pipeline": "ok",
    }


def test_the_command_prints_a_line_each_and_fails_when_one_does(capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.main(["doctor", "--set", f"master_url={NO_MASTER}", "--set", "token=x"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("ok       software  cellwatch ")
    assert lines[-1].startswith("FAIL     camera    ")
