# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from edge_unit.monitoring import StageTimer
from tests.set_clock import SetClock


def test_stages_follow_one_another_and_parts_are_told_apart() -> None:
    clock = SetClock(1_010)
    stages = StageTimer(1_000, clock)
    stages.end("source")
    clock.go_to(1_050)
    stages.end("rest", {"robot": 7, "filter": 30})
    assert list(stages.took_ns.items()) == [("source", 10), ("robot", 7), ("filter", 30), ("rest", 3)]
