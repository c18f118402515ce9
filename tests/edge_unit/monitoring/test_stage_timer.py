# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from edge_unit.monitoring import StageTimer
from edge_unit.monitoring import stage_timer as module


def test_stages_follow_one_another_and_parts_are_listed_separately(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = iter((1_010, 1_050))
    monkeypatch.setattr(module, "monotonic_ns", lambda: next(now_ns))
    stages = StageTimer(1_000)
    stages.end("source")
    stages.end("rest", {"robot": 7, "filter": 30})
    assert list(stages.took_ns.items()) == [("source", 10), ("robot", 7), ("filter", 30), ("rest", 3)]
