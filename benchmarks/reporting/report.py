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
"""What each run rewrites; no part of the source."""

NUMBERS = re.compile(r"\[\s+((?:(?:-?\d[\d.e+-]*|null),?\s+)+)\]")
"""A list of nothing but numbers, as `json` breaks it into lines."""


@dataclass(frozen=True)
class Mark:
    """A figure that must not be above (`at_most`) or below (`at_least`) a limit; `why` is what is known when it is."""

    name: str
    value: float
    at_most: float | None = None
    at_least: float | None = None
    why: str | None = None

    @property
    def met(self) -> bool:
        """A figure that is NaN meets nothing."""
        below = self.at_most is None or self.value <= self.at_most
        return below and (self.at_least is None or self.value >= self.at_least)

    def document(self) -> dict[str, Any]:
        """As plain values, without the bound that it does not have, and without excuse where it needs none."""
        given = {key: _plain(value) for key, value in asdict(self).items() if value is not None}
        if self.met:
            given.pop("why", None)
        return given | {"met": self.met}

    def __str__(self) -> str:
        bound = f"at most {self.at_most:g}" if self.at_most is not None else f"at least {self.at_least:g}"
        return f"{'met   ' if self.met else 'MISSED'}  {self.name}: {self.value:.4g} ({bound})"


@dataclass(frozen=True)
class Result:
    """What one sweep found: a table, marks, and remarks in words."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str | float, ...], ...]
    marks: tuple[Mark, ...] = ()
    remarks: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """As plain values; a row is an object by column."""
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
    """What one picture shows: lines over one axis, by name; labels of axes carry their units."""

    title: str
    x_label: str
    y_label: str
    series: Mapping[str, Sequence[tuple[float, float]]]
    logarithmic: str = ""
    """Axes with equal steps for equal ratios: "", "x", "y" or "xy"."""

    def document(self) -> dict[str, Any]:
        """As plain values; what was not measured has no point."""
        lines = {
            name: [[_plain(x), _plain(y)] for x, y in points if not math.isnan(y)]
            for name, points in self.series.items()
        }
        return asdict(self) | {"series": lines}


def table(columns: Sequence[str], rows: Iterable[Sequence[str | float]]) -> list[str]:
    """Lines of a table with the columns' names on top; numbers stand to the right."""
    cells = [list(columns)] + [[_text(value) for value in row] for row in rows]
    right = [all(not isinstance(row[i], str) for row in rows) for i in range(len(columns))]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    return [
        "  " + "  ".join(f"{cell:>{w}}" if r else f"{cell:<{w}}" for cell, w, r in zip(row, widths, right, strict=True))
        for row in cells
    ]


def line(document: dict[str, Any]) -> str:
    """`document` as one line of JSON."""
    return json.dumps(document, allow_nan=False, separators=(",", ":"))


def write(name: str, document: dict[str, Any], folder: Path = RESULTS) -> None:
    """Leave `document` in `folder`/`name`.json, with the circumstances under which it was `taken`."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = document | {"taken": circumstances()}
    text = json.dumps(kept, indent=1, allow_nan=False)
    # What is only numbers stands in one line, so that people can read and compare it.
    text = NUMBERS.sub(lambda found: f"[{' '.join(found[1].split())}]", text)
    (folder / f"{name}.json").write_text(text + "\n")


def _plain(value: str | float) -> str | float | None:
    """JSON knows no NaN; six digits are more than is known."""
    if not isinstance(value, float):
        return value
    return None if math.isnan(value) else float(f"{value:.6g}")


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"
