# SPDX-License-Identifier: Apache-2.0
"""The live table of the demo: redrawn in place on a terminal, one plain line at intervals elsewhere."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TextIO

from shared.clock import NS_PER_S

LINE_EVERY_S = 5.0
"""Period of lines without a terminal: often enough to show that the demo runs, rarely enough for a log."""

CLEAR_BELOW = "\x1b[J"
UP = "\x1b[{}A\r"


@dataclass(frozen=True)
class UnitLine:
    """One unit's row of the table; figures are None if not known."""

    name: str
    address: str
    state: str
    fps: float | None = None
    voxels: int | None = None
    process_ms: float | None = None
    age_s: float | None = None
    reason: str = ""


@dataclass(frozen=True)
class MapLine:
    """The merged map's row of the table."""

    voxels: int
    seen_share: float
    complete: bool
    reasons: tuple[str, ...] = ()


def table(units: Sequence[UnitLine], merged: MapLine | None) -> list[str]:
    """Return the lines of the table."""
    lines = [f"{'unit':<8}{'address':<14}{'state':<14}{'fps':>6}{'voxels':>9}{'ms/frame':>10}{'age ms':>8}"]
    for unit in units:
        lines.append(
            f"{unit.name:<8}{unit.address:<14}{unit.state:<14}"
            f"{_number(unit.fps, 1):>6}{_number(unit.voxels):>9}{_number(unit.process_ms, 1):>10}"
            f"{_number(None if unit.age_s is None else 1000.0 * unit.age_s):>8}"
            f"{'  ' + unit.reason if unit.reason else ''}"
        )
    lines.append(f"merged: {_merged(merged)}")
    return lines


def summary(units: Sequence[UnitLine], merged: MapLine | None) -> str:
    """Return the table in one line."""
    live = sum(unit.state == "live" for unit in units)
    fps = " ".join(_number(unit.fps, 1) for unit in units)
    return f"{live} of {len(units)} units live, fps {fps}; merged: {_merged(merged)}"


class Screen:
    """Output of the demo for a person."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._terminal = stream.isatty()
        self._drawn = 0
        self._last_line_ns: int | None = None

    def say(self, text: str) -> None:
        """Print a line that stays, above the table."""
        self._write(f"{self._erase()}{text}\n")

    def show(self, units: Sequence[UnitLine], merged: MapLine | None, now_ns: int) -> None:
        """Draw the state at `now_ns`."""
        if self._terminal:
            width = shutil.get_terminal_size().columns
            lines = [line[:width] for line in table(units, merged)]
            text = self._erase() + "".join(f"{line}\n" for line in lines)
            self._drawn = len(lines)
            self._write(text)
        elif self._last_line_ns is None or now_ns - self._last_line_ns >= LINE_EVERY_S * NS_PER_S:
            self._last_line_ns = now_ns
            self._write(f"{summary(units, merged)}\n")

    def leave(self) -> None:
        """Leave the table as it is; print further lines below it."""
        self._drawn = 0

    def _erase(self) -> str:
        """Return the control sequence that erases the table."""
        drawn, self._drawn = self._drawn, 0
        return UP.format(drawn) + CLEAR_BELOW if drawn else ""

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def _merged(merged: MapLine | None) -> str:
    if merged is None:
        return "nothing yet"
    state = "complete" if merged.complete else f"incomplete ({merged.reasons[0] if merged.reasons else 'no reason'})"
    return f"{merged.voxels:,} voxels, {merged.seen_share:.0%} of the cell seen, {state}"


def _number(value: float | None, decimals: int = 0) -> str:
    return "-" if value is None else f"{value:,.{decimals}f}"
