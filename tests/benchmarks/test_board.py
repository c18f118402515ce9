# SPDX-License-Identifier: Apache-2.0
"""The benchmark of board poses: one view, and the marks of good and bad poses."""

from __future__ import annotations

import math

from benchmarks.board import BOARDS, View, result, views


def test_a_view_meets_the_marks() -> None:
    board = BOARDS["infrared"][0]
    found = views("infrared", board, 1.0, 2)
    assert all(0.0 < view.error_mm < 1.0 for view in found)
    assert found[0].error_mm != found[1].error_mm
    table = result({("infrared", board, 1.0): found})
    assert len(table.marks) == 2
    assert all(mark.met for mark in table.marks)


def test_a_missing_or_wrong_pose_misses_the_marks() -> None:
    board = BOARDS["colour"][1]
    good, lost = View(1.0, 0.1, 1.0, 0.1, 0.1, 9.0), View(*(5 * (math.nan,)), 9.0)
    bad = View(4.0, 0.3, 1.0, 0.1, 0.1, 9.0)
    for poor in (lost, bad):
        assert all(mark.met for mark in result({("colour", board, 1.0): [good] * 19 + [poor]}).marks)
        assert not any(mark.met for mark in result({("colour", board, 1.0): [good] * 8 + [poor] * 2}).marks)
