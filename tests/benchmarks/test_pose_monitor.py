# SPDX-License-Identifier: Apache-2.0
"""The table of knocks with few trials; its marks can be missed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import pose_monitor
from benchmarks.pose_monitor import CHECKS_AFTER, KNOCKS, REPORTED_S_MAX, watch
from edge_unit.monitoring.pose_monitor import PERIOD_S


@pytest.mark.slow
def test_a_knock_is_reported_in_time_without_false_alarms() -> None:
    found = watch(0, 2, (424, 240), quiet_s=70.0, trials=1)
    assert found.alarms == []
    for name in KNOCKS:
        assert found.reported_s[name][0] <= REPORTED_S_MAX, name
        assert found.back_s[name][0] <= REPORTED_S_MAX, name


def test_an_unreported_knock_misses_the_mark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    late = CHECKS_AFTER * PERIOD_S

    def watched(
        number: int, people: int, size: tuple[int, int], quiet_s: float, trials: int
    ) -> pose_monitor.KnockTimes:
        reported = {name: [0.4, 0.6] for name in KNOCKS}
        if number == 3:
            reported["shifted by 20 mm"] = [late, float("nan")]
        return pose_monitor.KnockTimes(
            reported, {name: [1.0] for name in KNOCKS}, 100, ["shifted"] if number == 2 else []
        )

    monkeypatch.setattr(pose_monitor, "watch", watched)
    assert pose_monitor.main(["--results", str(tmp_path), "--processes", "1"]) == 1
    printed = capsys.readouterr().out
    document = json.loads(printed.splitlines()[-1])
    missed = {mark["name"] for mark in document["marks"] if not mark["met"]}
    assert missed == {"shifted by 20 mm: % not reported within 2 s", "false alarms, looks"}
    assert document["false_alarm_looks"] == 2
    assert np.isclose(document["camera_hours"], 8 * 100 * PERIOD_S / 3600)
    assert json.loads((tmp_path / "pose_monitor.json").read_text())["passed"] is False
