# SPDX-License-Identifier: Apache-2.0
"""The demo's live table: drawn anew in place on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TextIO

from shared.clock import NS_PER_S

LINE_EVERY_S = 5.0
"""Without a terminal: often enough to see that it lives, rarely enough for a log."""

CLEAR_BELOW = "\x1b[J"
UP = "\x1b[{}A\r"


@dataclass(frozen=True)
class UnitLine:
    """One unit as the table shows it; figures are None while there are none."""

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
    """The merged map as the table shows it."""

    voxels: int
    seen_share: float
    complete: bool
    reasons: tuple[str, ...] = ()


def table(units: Sequence[UnitLine], merged: MapLine | None) -> list[str]:
    """The lines of the table."""
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
    """The table in one line."""
    live = sum(unit.state == "live" for unit in units)
    fps = " ".join(_number(unit.fps, 1) for unit in units)
    return f"{live} of {len(units)} units live, fps {fps}; merged: {_merged(merged)}"


class Screen:
    """Where the demo talks to a person."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._terminal = stream.isatty()
        self._drawn = 0
        self._last_line_ns: int | None = None

    def say(self, text: str) -> None:
        """A line that stays, above the table."""
        self._write(f"{self._erase()}{text}\n")

    def show(self, units: Sequence[UnitLine], merged: MapLine | None, now_ns: int) -> None:
        """The state at `now_ns`."""
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
        """The table stays as it is; what is said from now on stands below."""
        self._drawn = 0

    def _erase(self) -> str:
        """Takes the table off the terminal."""
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
