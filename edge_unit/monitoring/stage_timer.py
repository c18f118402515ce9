# SPDX-License-Identifier: Apache-2.0
"""How long a frame spent in each stage of the unit, from its capture on."""

from __future__ import annotations

from collections.abc import Mapping

from shared.clock import monotonic_ns


class StageTimer:
    """Nanoseconds by stage, in the order of the flow; together they are the frame's age when the last one ended."""

    def __init__(self, captured_at_ns: int) -> None:
        self.took_ns: dict[str, int] = {}
        self._since_ns = captured_at_ns

    def end(self, name: str, parts_ns: Mapping[str, int] | None = None) -> None:
        """A stage ends now; what of it was measured apart as `parts_ns` is told apart, and comes first."""
        now_ns = monotonic_ns()
        parts_ns = parts_ns or {}
        self.took_ns.update(parts_ns)
        self.took_ns[name] = now_ns - self._since_ns - sum(parts_ns.values())
        self._since_ns = now_ns
