# SPDX-License-Identifier: Apache-2.0
"""The age of a map comes from the frames that were merged when it was made; one bench runs from end to end."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.load_generator.map_readers import Reading
from benchmarks.load_generator.merge_costs import merge_costs
from benchmarks.load_generator.scale_load import Step
from benchmarks.scale import Ages, Row, ages, cpu_fit, load_result, main
from shared.clock import NS_PER_MS

MS = NS_PER_MS

STEP = Step(4, 15.0, 0, 10**9, 60, 0, 60.0, 1.0, 2.0, 100.0, 200.0, 2000.0, 20.0, 0.0, 5.0, "", "")

FRESH = Ages(10, 20.0, 30.0, 40.0)


def reading(made_ms: int, decoded_ms: int) -> Reading:
    return Reading(made_ms * MS, made_ms * MS, decoded_ms * MS, decoded_ms * MS, 100, 3, True, 0.02)


def test_ages_come_from_the_frames_merged_before_the_map() -> None:
    merged = np.array([(0, 10, 30, 31), (1, 20, 40, 41), (0, 70, 90, 91)], np.int64)
    merged[:, 1:] *= MS
    found = ages(merged, [reading(50, 55), reading(95, 100), reading(200, 201)], 45 * MS, 150 * MS)
    # At 50 ms: frames of 10 and 20; at 95 ms: of 20 and 70.
    assert found == Ages(2, np.median([35.0, 30.0]), np.median([45.0, 80.0]), pytest.approx(80.0, abs=0.5))


def test_without_readings_there_is_no_age() -> None:
    assert math.isnan(ages(np.zeros((0, 4), np.int64), [], 0, 1).oldest_p50)


@pytest.mark.parametrize(
    ("step", "polled", "carried"),
    [
        (STEP, FRESH, True),
        (replace(STEP, lost=1), FRESH, False),
        (replace(STEP, map_wrong="expected 4 live units, got 3"), FRESH, False),
        (STEP, replace(FRESH, oldest_p99=501.0), False),
        (STEP, replace(FRESH, oldest_p99=math.nan), False),
    ],
)
def test_a_carried_load_arrives_and_is_right_and_fresh(step: Step, polled: Ages, carried: bool) -> None:
    assert Row(step, polled, FRESH, False).carried is carried


def test_the_cost_of_an_update_is_the_slope_where_there_was_cpu_left() -> None:
    steps = [replace(STEP, per_s=per_s, master_cpu_percent=10.0 + 0.02 * per_s) for per_s in (60.0, 480.0, 960.0)]
    rows = [Row(step, FRESH, FRESH, False) for step in (*steps, replace(STEP, per_s=5000.0, master_cpu_percent=99.0))]
    assert cpu_fit(rows) == (pytest.approx(200.0), pytest.approx(10.0))
    assert cpu_fit(rows[:2]) is None
    assert any("4500 updates a second" in remark for remark in load_result(rows, "").remarks)


def test_the_merge_of_more_units_has_more_voxels() -> None:
    one, four = merge_costs((1, 4), 100)
    assert one.map_voxels == 100
    assert 100 < four.map_voxels <= 400
    assert min(one.merge_us, one.union_us, one.answer_us) > 0.0


@pytest.mark.slow
def test_a_master_its_bound_and_one_without(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--units", "1", "65", "--rates", "5", "--seconds", "0.5", "--results", str(tmp_path)]
    main(arguments)
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [row["master"] for row in found["load"]["rows"]] == ["as it is", "unbounded"]
    assert [row["units"] for row in found["map_age"]["rows"]] == [1, 65]
    assert found["load"]["rows"][0]["map"] == "right"
    assert any("at most 64 units" in remark for remark in found["load"]["remarks"])
    assert json.loads((tmp_path / "scale.json").read_text())["units_carried"] == found["units_carried"]
