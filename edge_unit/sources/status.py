# SPDX-License-Identifier: Apache-2.0
"""The status of a source, reported at once: the master need not wait for a frame to know it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from shared.clock import monotonic_ns

SourceState = Literal["closed", "starting", "absent", "live", "silent", "restarting", "looking", "ended", "failed"]
"""
closed      not open
starting    the camera is connected and starts
absent      the configured camera is not connected
live        frames come
silent      it runs, but no frame came for longer than expected
restarting  capture failed and restarts
looking     it delivers images for calibration, and no depth meanwhile
ended       a recording has ended
failed      it will not recover by itself
"""

UNTROUBLED: frozenset[SourceState] = frozenset({"live", "ended", "closed"})


@dataclass(frozen=True)
class SourceStatus:
    """A state, its reason, its start (CLOCK_MONOTONIC), and a warning if frames come with a defect."""

    state: SourceState
    reason: str = ""
    warning: str = ""
    since_ns: int = 0

    @property
    def trouble(self) -> str | None:
        """The reason for which there are no frames, in one sentence; None if there are, or if none are requested."""
        if self.state in UNTROUBLED:
            return None
        return f"camera {self.state}: {self.reason}" if self.reason else f"camera {self.state}"


@runtime_checkable
class ReportsStatus(Protocol):
    """A source that reports its status."""

    @property
    def status(self) -> SourceStatus:
        """The current status."""
        ...

    async def next_status(self, known: SourceStatus) -> SourceStatus:
        """Wait until the status differs from `known`, and return it."""
        ...


class StatusBoard:
    """The status of one source, for any number of readers in one event loop."""

    def __init__(self) -> None:
        self.now = SourceStatus("closed", since_ns=monotonic_ns())
        self._changed = asyncio.Event()

    def post(self, state: SourceState, reason: str = "", warning: str = "") -> None:
        """Set the status, if it differs."""
        if (state, reason, warning) == (self.now.state, self.now.reason, self.now.warning):
            return
        self.now = SourceStatus(state, reason, warning, monotonic_ns())
        self._changed.set()
        self._changed = asyncio.Event()

    async def next(self, known: SourceStatus) -> SourceStatus:
        """Wait until the status differs from `known`, and return it."""
        while self.now == known:
            await self._changed.wait()
        return self.now
