# SPDX-License-Identifier: Apache-2.0
"""Work that ends in time, and work that does not."""

from __future__ import annotations

import pytest

from edge_unit.monitoring import StallDetector
from tests.set_clock import S, SetClock


def test_only_work_beyond_its_limit_is_stuck() -> None:
    clock = SetClock()
    progress = StallDetector(clock)
    clock.go_to(clock.now + 3600 * S)
    assert progress.stuck() is None
    with progress.working("compiling", 240.0), progress.working("frame 7", 5.0):
        clock.go_to(clock.now + 5 * S)
        assert progress.stuck() is None
        clock.go_to(clock.now + 1 * S)
        assert progress.stuck() == "frame 7 has not finished for 6 s, expected within 5 s"
    clock.go_to(clock.now + 3600 * S)
    assert progress.stuck() is None


def test_work_that_fails_has_come_to_its_end() -> None:
    clock = SetClock()
    progress = StallDetector(clock)
    with pytest.raises(ValueError, match="no"), progress.working("frame 7", 5.0):
        raise ValueError("no")
    clock.go_to(clock.now + 3600 * S)
    assert progress.stuck() is None
