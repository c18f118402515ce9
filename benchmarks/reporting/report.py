# SPDX-License-Identifier: Apache-2.0
"""Tables and curves for people, marks, and one line of JSON for machines."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.reporting.circumstances import circumstances

RESULTS = Path(__file__).resolve().parents[2] / "out" / "results"
"""Folder that each run rewrites. It is no part of the source."""

NUMBERS = re.compile(r"\[\s+((?:(?:-?\d[\d.e+-]*|null),?\s+)+)\]")
"""A list of only numbers, as `json` breaks it into lines."""


@dataclass(frozen=True)
class Mark:
    """A figure with an upper (`at_most`) or lower (`at_least`) limit. `why` is the known reason of a miss."""

    name: str
    value: float
    at_most: float | None = None
    at_least: float | None = None
    why: str | None = None

    @property
    def met(self) -> bool:
        """Return True if the figure is within the limit. NaN never is."""
        below = self.at_most is None or self.value <= self.at_most
        return below and (self.at_least is None or self.value >= self.at_least)

    def document(self) -> dict[str, Any]:
        """Return plain values without an unused bound. `why` is left out if the mark is met."""
        given = {key: _plain(value) for key, value in asdict(self).items() if value is not None}
        if self.met:
            given.pop("why", None)
        return given | {"met": self.met}

    def __str__(self) -> str:
        bound = f"at most {self.at_most:g}" if self.at_most is not None else f"at least {self.at_least:g}"
        return f"{'met   ' if self.met else 'MISSED'}  {self.name}: {self.value:.4g} ({bound})"


@dataclass(frozen=True)
class Result:
    """Result of one sweep: a table, marks, and remarks in words."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str | float, ...], ...]
    marks: tuple[Mark, ...] = ()
    remarks: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """Return plain values; each row is an object by column."""
        return {
            "title": self.title,
            "rows": [dict(zip(self.columns, map(_plain, row), strict=True)) for row in self.rows],
            "marks": [mark.document() for mark in self.marks],
            "remarks": list(self.remarks),
        }

    def __str__(self) -> str:
        lines = [self.title, *table(self.columns, self.rows), *self.remarks, *map(str, self.marks)]
        return "\n".join(lines)


@dataclass(frozen=True)
class Curves:
    """One plot: lines over one axis, by name. Labels of axes contain their units."""

    title: str
    x_label: str
    y_label: str
    series: Mapping[str, Sequence[tuple[float, float]]]
    logarithmic: str = ""
    """Logarithmic axes: "", "x", "y" or "xy"."""

    def document(self) -> dict[str, Any]:
        """Return plain values. A missing measurement has no point."""
        lines = {
            name: [[_plain(x), _plain(y)] for x, y in points if not math.isnan(y)]
            for name, points in self.series.items()
        }
        return asdict(self) | {"series": lines}


def table(columns: Sequence[str], rows: Iterable[Sequence[str | float]]) -> list[str]:
    """Return the lines of a table with the columns' names on top. Numbers are right-aligned."""
    cells = [list(columns)] + [[_text(value) for value in row] for row in rows]
    right = [all(not isinstance(row[i], str) for row in rows) for i in range(len(columns))]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    return [
        "  " + "  ".join(f"{cell:>{w}}" if r else f"{cell:<{w}}" for cell, w, r in zip(row, widths, right, strict=True))
        for row in cells
    ]


def line(document: dict[str, Any]) -> str:
    """Return `document` as one line of JSON."""
    return json.dumps(document, allow_nan=False, separators=(",", ":"))


def write(name: str, document: dict[str, Any], folder: Path = RESULTS) -> None:
    """Write `document` to `folder`/`name`.json, with the circumstances in which it was `taken`."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = document | {"taken": circumstances()}
    text = json.dumps(kept, indent=1, allow_nan=False)
    # Lists of only numbers stand in one line, so that people can read and compare them.
    text = NUMBERS.sub(lambda found: f"[{' '.join(found[1].split())}]", text)
    (folder / f"{name}.json").write_text(text + "\n")


def _plain(value: str | float) -> str | float | None:
    """Round to six digits, more than the measurement is precise to. NaN becomes None, because JSON has no NaN."""
    if not isinstance(value, float):
        return value
    return None if math.isnan(value) else float(f"{value:.6g}")


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"
