# SPDX-License-Identifier: Apache-2.0
"""Whether the work on frames makes progress: what is being done, and by when it must be done.

Waiting for a camera, a frame or a master is no work and may take for ever; what a thread computes may not.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from shared.clock import NS_PER_S, monotonic_ns


class StallDetector:
    """Work that is under way, each piece with its limit."""

    def __init__(self) -> None:
        self._open: dict[object, tuple[str, int, float]] = {}

    @contextmanager
    def working(self, what: str, limit_s: float) -> Iterator[None]:
        """Whoever enters is at work at `what`, and is stuck when it has not left within `limit_s`."""
        key = object()
        self._open[key] = what, monotonic_ns(), limit_s
        try:
            yield
        finally:
            del self._open[key]

    def stuck(self, now_ns: int) -> str | None:
        """What has not come to its end in time, in one sentence; None while all goes well."""
        for what, began_ns, limit_s in list(self._open.values()):
            took_s = (now_ns - began_ns) / NS_PER_S
            if took_s > limit_s:
                return f"{what} has not come to its end for {took_s:.0f} s, expected within {limit_s:g} s"
        return None
