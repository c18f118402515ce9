# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from benchmarks.bench import keep, run
from benchmarks.reporting.parts import PARTS, Part

ROOT = Path(__file__).resolve().parents[2]

WRITES = """
import sys
from pathlib import Path
from benchmarks.reporting.report import write
write("made", {"marks": []}, Path(sys.argv[1]))
sys.exit(1)
"""


def part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, limit_s: float = 60.0) -> Part:
    """Return a part whose module is `source`."""
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "made.py").write_text(source)
    monkeypatch.setenv("PYTHONPATH", f"{folder}:{ROOT}")
    return Part("made", "made", "Made", "Is it?", limit_s=limit_s, arguments=(str(tmp_path),))


def test_a_part_with_a_result_has_measured_at_any_exit_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(part(tmp_path, monkeypatch, WRITES), tmp_path)["trouble"] == ""


def test_an_old_result_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "made.json").write_text("{}")
    made = part(tmp_path, monkeypatch, "raise ImportError('no such peer')")
    assert run(made, tmp_path)["trouble"] == "no result, exit code 1"


def test_a_part_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = part(tmp_path, monkeypatch, "import threading; threading.Event().wait()", limit_s=0.5)
    found = run(made, tmp_path)
    assert found["trouble"] == "not finished within 0.5 s"
    assert found["seconds"] < 10.0


@pytest.mark.parametrize("each", PARTS, ids=lambda each: each.name)
def test_each_part_is_a_module_and_a_target_of_make(each: Part) -> None:
    assert importlib.util.find_spec(each.module) is not None
    assert re.search(rf"^{each.target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def test_only_measured_parts_replace_the_baseline(tmp_path: Path) -> None:
    results, baseline = tmp_path / "results", tmp_path / "baseline"
    results.mkdir()
    baseline.mkdir()
    (results / "real.json").write_text("new")
    (results / "something_else.json").write_text("new")
    for name in ("real.json", "sweeps.json"):
        (baseline / name).write_text("old")
    assert keep(results, baseline) == ["real"]
    assert {file.name: file.read_text() for file in baseline.iterdir()} == {"real.json": "new", "sweeps.json": "old"}
