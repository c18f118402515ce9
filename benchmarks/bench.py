# SPDX-License-Identifier: Apache-2.0
"""`make bench`: the parts of the report that fit into twenty minutes, one after the other, and the page of all.

Each part is a process of its own, as when it runs alone: none finds another's caches, threads or memory. The page is
`out/REPORT.md`, and shows the baseline where nothing was measured. With `--keep` the results become the baseline, and
the page is `benchmarks/REPORT.md`.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.reporting.page import BASELINE, REPORT, write_page
from benchmarks.reporting.parts import PARTS, Part
from benchmarks.reporting.report import RESULTS, line, table
from shared.clock import NS_PER_S, monotonic_ns


def run(part: Part, results: Path = RESULTS) -> dict[str, Any]:
    """Run one part to its end; returns how long it took, and what kept it from leaving a result."""
    print(f"\n== {part.title} (make {part.target}) ==", flush=True)
    result = results / f"{part.name}.json"
    before_ns = result.stat().st_mtime_ns if result.exists() else None
    began_ns = monotonic_ns()
    try:
        code = subprocess.run((sys.executable, "-m", part.runs, *part.arguments), timeout=part.limit_s).returncode
        # Exit codes do not tell a missed mark from a crash; a result that was left does.
        left = result.exists() and result.stat().st_mtime_ns != before_ns
        trouble = "" if left else f"no result, exit code {code}"
    except subprocess.TimeoutExpired:
        trouble = f"it did not end within {part.limit_s:g} s"
    return {"part": part.name, "seconds": round((monotonic_ns() - began_ns) / NS_PER_S, 1), "trouble": trouble}


def keep(results: Path, baseline: Path) -> list[str]:
    """Make what lies in `results` the baseline; returns the names of the parts."""
    kept = [part.name for part in PARTS if (results / f"{part.name}.json").exists()]
    baseline.mkdir(parents=True, exist_ok=True)
    for name in kept:
        shutil.copyfile(results / f"{name}.json", baseline / f"{name}.json")
    return kept


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, write the page, and tell all marks as one line of JSON. Exit code 1 when one is missed or a part failed."""
    options = _parser().parse_args(arguments)
    parts = [part for part in PARTS if (part.name in options.only if options.only else part.limit_s is not None)]
    ran = [] if options.page_only else [run(part) for part in parts]
    if options.keep:
        keep(RESULTS, BASELINE)
    report: Path = options.report or (REPORT if options.keep else RESULTS.parent / REPORT.name)
    report.parent.mkdir(parents=True, exist_ok=True)
    marks = write_page((BASELINE,) if options.keep else (RESULTS, BASELINE), report)
    missed = [f"{mark['part']}: {mark['name']}" for mark in marks if not mark["met"]]
    failed = [row["part"] for row in ran if row["trouble"]]
    print(f"\n{report}: {len(marks)} marks, {len(missed)} missed")
    if ran:
        print("\n".join(table(("part", "seconds", "trouble"), [tuple(row.values()) for row in ran])))
    print(line({"parts": ran, "marks": len(marks), "missed": missed, "failed": failed}))
    return 1 if missed or failed else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make bench", description="What was claimed, measured anew.")
    names = [part.name for part in PARTS]
    parser.add_argument("--only", nargs="+", choices=names, default=[], help="these parts, also such that take longer")
    parser.add_argument("--page-only", action="store_true", help="write the page from the results that are there")
    parser.add_argument("--keep", action="store_true", help="make the results the baseline of benchmarks/REPORT.md")
    parser.add_argument("--report", type=Path, metavar="FILE", help="the page, elsewhere")
    return parser


if __name__ == "__main__":
    sys.exit(main())
