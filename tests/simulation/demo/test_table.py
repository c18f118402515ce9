# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io

from shared.clock import NS_PER_S
from simulation.demo.table import CLEAR_BELOW, LINE_EVERY_S, MapLine, Screen, UnitLine, summary, table

UNITS = (
    UnitLine("unit-1", "127.0.0.2", "live", 15.02, 1234, 1.26, 0.0414),
    UnitLine("unit-2", "127.0.0.3", "dead", reason="exit code 1"),
)
MERGED = MapLine(1290, 0.674, False, ("unit 2 is stale: silent", "another"))


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_every_unit_has_a_row_and_the_map_has_the_last() -> None:
    head, first, second, last = table(UNITS, MERGED)
    assert head.split() == ["unit", "address", "state", "fps", "voxels", "ms/frame", "age", "ms"]
    assert first.split() == ["unit-1", "127.0.0.2", "live", "15.0", "1,234", "1.3", "41"]
    assert second.split() == ["unit-2", "127.0.0.3", "dead", "-", "-", "-", "-", "exit", "code", "1"]
    assert last == "merged: 1,290 voxels, 67% of the cell seen, incomplete (unit 2 is stale: silent)"


def test_the_summary_is_one_line() -> None:
    assert summary(UNITS, None) == "1 of 2 units live, fps 15.0 -; merged: nothing yet"


def test_a_terminal_is_drawn_in_place() -> None:
    terminal = Terminal()
    screen = Screen(terminal)
    screen.show(UNITS, MERGED, 0)
    first = terminal.getvalue()
    assert CLEAR_BELOW not in first
    screen.show(UNITS, MERGED, 1)
    assert terminal.getvalue() == f"{first}\x1b[{first.count(chr(10))}A\r{CLEAR_BELOW}{first}"


def test_printed_lines_stay_above_the_table_until_the_end() -> None:
    terminal = Terminal()
    screen = Screen(terminal)
    screen.show(UNITS, MERGED, 0)
    screen.say("hello")
    assert terminal.getvalue().endswith(f"{CLEAR_BELOW}hello\n")
    screen.show(UNITS, MERGED, 1)
    screen.leave()
    before = terminal.getvalue()
    screen.say("bye")
    assert terminal.getvalue() == f"{before}bye\n"


def test_without_a_terminal_lines_are_periodic() -> None:
    log = io.StringIO()
    screen = Screen(log)
    for tenth in range(round(20 * LINE_EVERY_S)):
        screen.show(UNITS, MERGED, tenth * NS_PER_S // 10)
    assert log.getvalue() == f"{summary(UNITS, MERGED)}\n" * 2
