# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.reporting.page import BASELINE, MARKS_OPEN_MAX, REPORT, ROWS_OPEN_MAX, marks_in, write_page
from benchmarks.reporting.parts import PARTS
from benchmarks.reporting.report import Curves, Mark, Result, write

MET = Mark("real frames: leak, %", 0.01, at_most=0.3)
MISSED = Mark("times faster", 29.0, at_least=30.0, why="backs of links are drawn")
CURVES = Curves("Recall over distance", "distance, m", "recall, %", {"ours": [(0.5, 99.5), (4.0, 90.0)], "x": []})


@pytest.fixture
def results(tmp_path: Path) -> Path:
    long = Result("Long", ("n",), tuple((n,) for n in range(ROWS_OPEN_MAX + 1)))
    table = Result("Costs", ("what", "ms"), (("process()", 1.9372), ("a | b", 12345.6)), (MISSED,), ("One thread.",))
    write("pipeline", {"deep": {"table": table.document()}, "passed": False}, tmp_path / "results")
    write(
        "real",
        {"marks": [MET.document()], "curves": [CURVES.document()], "long": long.document()},
        tmp_path / "results",
    )
    return tmp_path / "results"


def page(results: Path) -> str:
    write_page((results,), results.parent / "REPORT.md")
    return (results.parent / "REPORT.md").read_text()


def test_all_marks_are_found_however_deep_they_lie(results: Path) -> None:
    marks = write_page((results,), results.parent / "REPORT.md")
    assert [(mark["part"], mark["name"], mark["met"]) for mark in marks] == [
        ("pipeline", MISSED.name, False),
        ("real", MET.name, True),
    ]


def test_a_missed_mark_comes_first_with_its_reason(results: Path) -> None:
    overview, _, _ = page(results).partition("# Results in full")
    assert "| times faster | 29 | ≥ 30 | **missed** |" in overview
    assert "- times faster: backs of links are drawn" in overview
    assert "| real frames: leak, % | 0.01 | ≤ 0.3 | met |" in overview


def test_missing_measurements_are_reported(results: Path) -> None:
    text = page(results)
    absent = [part for part in PARTS if part.name not in ("pipeline", "real")]
    assert absent
    for part in absent:
        assert f"Not measured yet: `make {part.target}`." in text


def test_a_result_of_today_precedes_the_baseline(results: Path, tmp_path: Path) -> None:
    write("real", {"marks": [MET.document() | {"value": 0.2}]}, tmp_path / "today")
    marks = write_page((tmp_path / "today", results), tmp_path / "REPORT.md")
    assert [(mark["part"], mark["value"]) for mark in marks] == [("pipeline", MISSED.value), ("real", 0.2)]


def test_tables_are_whole_and_long_ones_folded(results: Path) -> None:
    text = page(results)
    assert "| process() | 1.937 |\n| a \\| b | 12,346 |" in text
    assert "One thread." in text
    assert f"<summary>Long ({ROWS_OPEN_MAX + 1} rows)</summary>" in text


def test_many_marks_are_one_row_and_stand_in_full_below(results: Path) -> None:
    many = [Mark(f"mark {n}", float(n), at_most=MARKS_OPEN_MAX).document() for n in range(MARKS_OPEN_MAX + 2)]
    write("sweeps", {"marks": many}, results)
    overview, _, full = page(results).partition("# Results in full")
    assert f"{MARKS_OPEN_MAX + 1} of {MARKS_OPEN_MAX + 2} met" in overview
    assert "| mark 0 |" not in overview
    assert f"| mark {MARKS_OPEN_MAX + 1} |" in overview
    assert "| mark 0 |" in full


def test_curves_become_a_picture_that_stays_the_same(results: Path) -> None:
    assert "![Recall over distance](plots/real_recall_over_distance.png)" in page(results)
    picture = results.parent / "plots" / "real_recall_over_distance.png"
    first = picture.read_bytes()
    assert first.startswith(b"\x89PNG")
    page(results)
    assert picture.read_bytes() == first


def test_a_result_without_marks_has_none() -> None:
    assert list(marks_in({"rows": [1, {"marks": []}], "marks": ["not one"]})) == []


def test_the_checked_in_page_is_the_one_of_the_baseline(tmp_path: Path) -> None:
    write_page((BASELINE,), tmp_path / "REPORT.md")
    assert REPORT.read_text() == (tmp_path / "REPORT.md").read_text()
