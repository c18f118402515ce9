# SPDX-License-Identifier: Apache-2.0
"""Time that a frame spent in each stage of the unit, from its capture on."""

from __future__ import annotations

from collections.abc import Mapping

from shared.waiting import LOOP_CLOCK, Clock


class StageTimer:
    """Nanoseconds by stage, in the order of the flow; their sum is the frame's age at the end of the last stage."""

    def __init__(self, captured_at_ns: int, clock: Clock = LOOP_CLOCK) -> None:
        self._clock = clock
        self.took_ns: dict[str, int] = {}
        self._since_ns = captured_at_ns

    def end(self, name: str, parts_ns: Mapping[str, int] | None = None) -> None:
        """End a stage now; `parts_ns`, measured separately, are listed separately and first."""
        now_ns = self._clock.now_ns()
        parts_ns = parts_ns or {}
        self.took_ns.update(parts_ns)
        self.took_ns[name] = now_ns - self._since_ns - sum(parts_ns.values())
        self._since_ns = now_ns
