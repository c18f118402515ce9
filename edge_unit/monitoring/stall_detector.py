# SPDX-License-Identifier: Apache-2.0
"""Detection of stalled work on frames: each piece of work has a time limit.

Waiting for a camera, a frame or a master is not work and may take any time; a computation in a thread may not.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from shared.clock import NS_PER_S
from shared.waiting import LOOP_CLOCK, Clock


class StallDetector:
    """Work in progress, each piece with its time limit."""

    def __init__(self, clock: Clock = LOOP_CLOCK) -> None:
        self._clock = clock
        self._open: dict[object, tuple[str, int, float]] = {}

    @contextmanager
    def working(self, what: str, limit_s: float) -> Iterator[None]:
        """Mark `what` as in progress within the context; it is stalled if the context lasts longer than `limit_s`."""
        key = object()
        self._open[key] = what, self._clock.now_ns(), limit_s
        try:
            yield
        finally:
            del self._open[key]

    def stuck(self) -> str | None:
        """Describe the work that exceeded its limit in one sentence; None if there is none."""
        now_ns = self._clock.now_ns()
        for what, began_ns, limit_s in list(self._open.values()):
            took_s = (now_ns - began_ns) / NS_PER_S
            if took_s > limit_s:
                return f"{what} has not finished for {took_s:.0f} s, expected within {limit_s:g} s"
        return None
