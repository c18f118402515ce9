# SPDX-License-Identifier: Apache-2.0
"""Work that ends in time, and work that does not."""

from __future__ import annotations

import pytest

from edge_unit.monitoring import StallDetector
from shared.clock import NS_PER_S, monotonic_ns


def test_only_work_beyond_its_limit_is_stuck() -> None:
    progress = StallDetector()
    assert progress.stuck(monotonic_ns() + 3600 * NS_PER_S) is None
    with progress.working("compiling", 240.0), progress.working("frame 7", 5.0):
        now_ns = monotonic_ns()
        assert progress.stuck(now_ns) is None
        assert progress.stuck(now_ns + 6 * NS_PER_S) == ("frame 7 has not finished for 6 s, expected within 5 s")
    assert progress.stuck(monotonic_ns() + 3600 * NS_PER_S) is None


def test_work_that_fails_has_come_to_its_end() -> None:
    progress = StallDetector()
    with pytest.raises(ValueError, match="no"), progress.working("frame 7", 5.0):
        raise ValueError("no")
    assert progress.stuck(monotonic_ns() + 3600 * NS_PER_S) is None
