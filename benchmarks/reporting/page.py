# SPDX-License-Identifier: Apache-2.0
"""All results as one page with tables and plots, `REPORT.md`: figures, time, machine and method."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.reporting.parts import PARTS, Part
from benchmarks.reporting.plots import draw

FOLDER = Path(__file__).resolve().parents[1]
REPORT = FOLDER / "REPORT.md"
BASELINE = FOLDER / "baseline"
"""Results that `REPORT.md` shows, kept with the source."""

ROWS_OPEN_MAX = 24
"""A longer table is folded; the reader can open it."""

MARKS_OPEN_MAX = 8
"""A part with more marks is one row of the overview, plus its missed marks. Its section lists all of them."""

MARKS_HEAD = ["| | measured | mark | |", "| --- | ---: | ---: | --- |"]

INTRODUCTION = """\
# What was measured

The section of each figure names the command that measured it, and the commit of the source. `make bench` measures
the parts that fit into some 20 minutes on two idle cores; the other commands run by themselves.
`make bench ARGS="--page-only --keep"` makes their last results the baseline that this page shows. Times on shared
machines are noisy: contenders take turns within one run, medians count, and claims are ratios within one run where
possible. Nothing here was measured on a Jetson or with a live camera.
"""


def write_page(results: Sequence[Path], report: Path = REPORT) -> list[dict[str, Any]]:
    """Write `report`, with its plots in `plots/` beside it. Return all marks.

    The result of each part comes from the first of the folders `results` that has one.
    """
    found = {part.name: document for part in PARTS if (document := _read(results, f"{part.name}.json")) is not None}
    marks = [mark | {"part": name} for name, document in found.items() for mark in marks_in(document)]
    lines = [INTRODUCTION, *_overview(found), *_missed(found), "# Results in full", ""]
    for part in PARTS:
        if part.name in found:
            lines += _section(part, found[part.name], report.parent)
        else:
            lines += [f"## {part.title}", "", f"Not measured yet: `make {part.target}`.", ""]
    report.write_text("\n".join(lines).rstrip() + "\n")
    return marks


def marks_in(document: Any) -> Iterator[dict[str, Any]]:
    """Iterate over every mark of a result, at any depth."""
    for node in _nodes(document):
        for mark in node.get("marks", ()):
            if isinstance(mark, dict) and "met" in mark:
                yield mark


def _overview(found: dict[str, dict[str, Any]]) -> list[str]:
    lines = ["# Marks", "", *MARKS_HEAD]
    for part in PARTS:
        marks = list(marks_in(found.get(part.name, {})))
        if not marks:
            continue
        met = sum(mark["met"] for mark in marks)
        lines.append(f"| **[{part.title}](#{_anchor(part.title)})** | | | {met} of {len(marks)} met |")
        shown = marks if len(marks) <= MARKS_OPEN_MAX else [mark for mark in marks if not mark["met"]]
        lines += [_mark_row(mark) for mark in shown]
    return [*lines, ""]


def _missed(found: dict[str, dict[str, Any]]) -> list[str]:
    missed = [mark for part in PARTS for mark in marks_in(found.get(part.name, {})) if not mark["met"]]
    if not missed:
        return ["All marks were met.", ""]
    reasons = [f"- {mark['name']}: {mark.get('why', 'the reason is unknown')}" for mark in missed]
    return ["Missed marks, and their known reasons:", "", *reasons, ""]


def _mark_row(mark: dict[str, Any]) -> str:
    bound = f"≤ {mark['at_most']:g}" if "at_most" in mark else f"≥ {mark['at_least']:g}"
    return f"| {mark['name']} | {_cell(mark.get('value'))} | {bound} | {'met' if mark['met'] else '**missed**'} |"


def _section(part: Part, document: dict[str, Any], folder: Path) -> list[str]:
    lines = [f"## {part.title}", "", part.question, "", *_taken(part, document.get("taken")), ""]
    for node in _nodes(document):
        if "title" in node and "rows" in node:
            lines += _table(node)
        elif "title" in node and "series" in node:
            picture = draw(node, folder / "plots", part.name)
            lines += [f"![{node['title']}]({picture.relative_to(folder).as_posix()})", ""]
    marks = [_mark_row(mark) for mark in marks_in(document)]
    return lines + (_folded(f"{len(marks)} marks", MARKS_HEAD + marks) if len(marks) > MARKS_OPEN_MAX else [])


def _taken(part: Part, taken: dict[str, Any] | None) -> list[str]:
    again = f"`make {part.target}`"
    if taken is None:
        return [f"Again: {again}."]
    packages = ", ".join(f"{name} {version}" for name, version in taken["packages"].items())
    return [
        f"Taken {taken['at']} of {taken['source']}, on {taken['cores']} cores of {taken['cpu']}, "
        f"{taken['memory_gib']:g} GiB, {taken['system']}, Python {taken['python']}, {packages}; "
        f"load before the run: {taken['load_average_before']:g}. Again: {again}."
    ]


def _table(result: dict[str, Any]) -> list[str]:
    rows: list[dict[str, Any]] = result["rows"]
    remarks = [" ".join(result["remarks"]), ""] if result.get("remarks") else []
    if not rows:
        return [f"**{result['title']}**: nothing.", "", *remarks]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = [all(isinstance(row.get(name), str) for row in rows) for name in columns]
    body = [
        _row(columns),
        _row("---" if words else "---:" for words in text),
        *(_row(_cell(row.get(name)) for name in columns) for row in rows),
    ]
    if len(rows) > ROWS_OPEN_MAX:
        return [*_folded(f"{result['title']} ({len(rows)} rows)", body), *remarks]
    return [f"**{result['title']}**", "", *body, "", *remarks]


def _folded(summary: str, body: list[str]) -> list[str]:
    return [f"<details><summary>{summary}</summary>", "", *body, "", "</details>", ""]


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(value: Any) -> str:
    """Format four digits, which is the precision of such a measurement. Counts are written in full."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value).replace("|", "\\|")


def _anchor(title: str) -> str:
    return "".join(letter for letter in title.lower().replace(" ", "-") if letter.isalnum() or letter == "-")


def _nodes(document: Any) -> Iterator[dict[str, Any]]:
    """Iterate over each object of a document in its order, outer ones first."""
    if isinstance(document, dict):
        yield document
        for value in document.values():
            yield from _nodes(value)
    elif isinstance(document, list):
        for value in document:
            yield from _nodes(value)


def _read(folders: Sequence[Path], name: str) -> dict[str, Any] | None:
    path = next((folder / name for folder in folders if (folder / name).exists()), None)
    if path is None:
        return None
    document: dict[str, Any] = json.loads(path.read_text())
    return document
