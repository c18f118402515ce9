# SPDX-License-Identifier: Apache-2.0
"""`make bench`: run the parts of the report that fit into twenty minutes, one after the other, and write the page of
all parts.

Each part is a process of its own, as when it runs alone, so no part finds the caches, threads or memory of another. The
page is `out/REPORT.md`; it shows the baseline for every part that was not measured. With `--keep` the results replace
the baseline, and the page is `benchmarks/REPORT.md`.
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
    """Run one part to its end. Return its duration, and the reason if it left no result."""
    print(f"\n== {part.title} (make {part.target}) ==", flush=True)
    result = results / f"{part.name}.json"
    before_ns = result.stat().st_mtime_ns if result.exists() else None
    began_ns = monotonic_ns()
    try:
        code = subprocess.run((sys.executable, "-m", part.module, *part.arguments), timeout=part.limit_s).returncode
        # An exit code does not distinguish a missed mark from a crash. A result file does.
        left = result.exists() and result.stat().st_mtime_ns != before_ns
        trouble = "" if left else f"no result, exit code {code}"
    except subprocess.TimeoutExpired:
        trouble = f"not finished within {part.limit_s:g} s"
    return {"part": part.name, "seconds": round((monotonic_ns() - began_ns) / NS_PER_S, 1), "trouble": trouble}


def keep(results: Path, baseline: Path) -> list[str]:
    """Copy the results in `results` to the baseline. Return the names of the parts."""
    kept = [part.name for part in PARTS if (results / f"{part.name}.json").exists()]
    baseline.mkdir(parents=True, exist_ok=True)
    for name in kept:
        shutil.copyfile(results / f"{name}.json", baseline / f"{name}.json")
    return kept


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parts, write the page, and print all marks as one line of JSON. The exit code is 1 when a mark is missed
    or a part failed.
    """
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
    parser = argparse.ArgumentParser(prog="make bench", description="Measure the figures of the report again.")
    names = [part.name for part in PARTS]
    parser.add_argument(
        "--only", nargs="+", choices=names, default=[], help="only these parts; they may be parts that run alone"
    )
    parser.add_argument("--page-only", action="store_true", help="write the page from existing results")
    parser.add_argument("--keep", action="store_true", help="make the results the baseline of benchmarks/REPORT.md")
    parser.add_argument("--report", type=Path, metavar="FILE", help="path of the page")
    return parser


if __name__ == "__main__":
    sys.exit(main())
