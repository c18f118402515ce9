# SPDX-License-Identifier: Apache-2.0
"""A rate limiter: drops frames beyond `fps_max`."""

from __future__ import annotations

from shared.clock import NS_PER_S

EARLY_SHARE = 0.9
"""Part of the period after which the next frame is due: the camera's own jitter must not cost every second frame."""


class FrameLimiter:
    """Passes at most `fps_max` frames a second; all of them if it is None."""

    def __init__(self, fps_max: float | None) -> None:
        self._period_ns = None if fps_max is None else round(EARLY_SHARE * NS_PER_S / fps_max)
        self._next_at_ns = 0

    def due(self, captured_at_ns: int) -> bool:
        """Return True if the frame of this time is to be processed; the next one is due a period later."""
        if self._period_ns is None:
            return True
        if captured_at_ns < self._next_at_ns:
            return False
        self._next_at_ns = captured_at_ns + self._period_ns
        return True
