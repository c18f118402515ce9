# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from benchmarks.reporting.report import Curves, Mark, Result, line, table, write


def test_marks_have_bounds_on_either_side() -> None:
    assert Mark("share", 0.5, at_most=0.5).met
    assert not Mark("share", 0.51, at_most=0.5).met
    assert Mark("share", 99.0, at_least=99.0).met
    assert not Mark("share", 98.9, at_least=99.0).met


@pytest.mark.parametrize("bound", [{"at_most": 1.0}, {"at_least": 0.0}])
def test_a_missing_measurement_meets_no_mark(bound: dict[str, float]) -> None:
    mark = Mark("share", math.nan, **bound)
    assert not mark.met
    assert mark.document() == {"name": "share", "value": None, **bound, "met": False}


def test_numbers_stand_to_the_right_below_their_column() -> None:
    assert table(("thing", "lost %"), [("rod", 0.123456), ("a long plate", 100.0)]) == [
        "  thing         lost %",
        "  rod           0.1235",
        "  a long plate     100",
    ]


def test_a_result_is_valid_json(tmp_path: Path) -> None:
    result = Result("Curve", ("distance m", "thinnest mm"), ((1.0, 60.0), (3.0, math.nan)), (Mark("a", 1.0, 2.0),))
    write("curve", result.document(), tmp_path)
    kept = json.loads((tmp_path / "curve.json").read_text())
    taken = kept.pop("taken")
    assert taken["cores"] >= 1
    assert taken["packages"]["numpy"]
    assert taken["source"]
    assert kept == json.loads(line(result.document()))
    assert kept["rows"] == [{"distance m": 1.0, "thinnest mm": 60.0}, {"distance m": 3.0, "thinnest mm": None}]
    assert "\n" not in line(result.document())
    assert "met     a: 1 (at most 2)" in str(result)


def test_only_a_missed_mark_has_a_reason() -> None:
    assert Mark("times", 29.0, at_least=30.0, why="backs are drawn").document()["why"] == "backs are drawn"
    assert "why" not in Mark("times", 31.0, at_least=30.0, why="backs are drawn").document()


def test_a_missing_measurement_has_no_point() -> None:
    curves = Curves("Recall", "distance, m", "%", {"ours": [(0.5, 99.0), (4.0, math.nan)]})
    assert curves.document()["series"] == {"ours": [[0.5, 99.0]]}
