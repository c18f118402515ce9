# SPDX-License-Identifier: Apache-2.0
"""The state of a unit in one line for a person: its trouble, or its frames a second."""

from __future__ import annotations

import logging

from shared.clock import NS_PER_S
from shared.waiting import Clock

logger = logging.getLogger(__name__)


class UnitStatus:
    """The trouble of the last frame, and the number of frames since the last call of `line`."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._trouble: str | None = "no frame yet"
        self._frames = 0
        self._asked = 0, clock.now_ns()

    def note_frame(self, trouble: str | None) -> None:
        """Count a processed frame; log the begin and the end of trouble."""
        self._frames += 1
        if (trouble is None) != (self._trouble is None):
            logger.info("%s", trouble or "frames are filtered and reported")
        self._trouble = trouble

    def note_trouble(self, trouble: str) -> None:
        """Record the reason for which frames are not processed."""
        self._trouble = trouble

    def line(self, camera_trouble: str | None) -> str:
        """Return the camera's trouble, that of the last frame, or frames a second since the last call."""
        now_ns = self._clock.now_ns()
        (before, since_ns), self._asked = self._asked, (self._frames, now_ns)
        fps = (self._frames - before) * NS_PER_S / max(now_ns - since_ns, 1)
        return camera_trouble or self._trouble or f"live, {fps:.1f} fps"
