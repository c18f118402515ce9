# SPDX-License-Identifier: Apache-2.0
"""How a source is doing, told at once and without a frame: the master must not wait for a picture to learn of it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from shared.clock import monotonic_ns

SourceState = Literal["closed", "starting", "absent", "live", "silent", "restarting", "looking", "ended", "failed"]
"""
closed      not open
starting    the camera is there and is being started
absent      the wanted camera is not there
live        frames come
silent      it runs, but no frame came for longer than it should take
restarting  capture failed and is begun anew
looking     it delivers pictures for calibration, and no depth meanwhile
ended       a recording has come to its end
failed      it will not recover by itself
"""

UNTROUBLED: frozenset[SourceState] = frozenset({"live", "ended", "closed"})


@dataclass(frozen=True)
class SourceStatus:
    """A state, why, since when (CLOCK_MONOTONIC), and what is worse than it need be although frames come."""

    state: SourceState
    reason: str = ""
    warning: str = ""
    since_ns: int = 0

    @property
    def trouble(self) -> str | None:
        """Why there are no frames, in one sentence; None when there are, or when nobody wants any."""
        if self.state in UNTROUBLED:
            return None
        return f"camera {self.state}: {self.reason}" if self.reason else f"camera {self.state}"


@runtime_checkable
class ReportsStatus(Protocol):
    """A source that tells how it is doing."""

    @property
    def status(self) -> SourceStatus:
        """How it is doing now."""
        ...

    async def next_status(self, known: SourceStatus) -> SourceStatus:
        """Wait until the status is another than `known`, and return it."""
        ...


class StatusBoard:
    """The status of one source, for any number of readers in one event loop."""

    def __init__(self) -> None:
        self.now = SourceStatus("closed", since_ns=monotonic_ns())
        self._changed = asyncio.Event()

    def post(self, state: SourceState, reason: str = "", warning: str = "") -> None:
        """Make this the status, unless it is already."""
        if (state, reason, warning) == (self.now.state, self.now.reason, self.now.warning):
            return
        self.now = SourceStatus(state, reason, warning, monotonic_ns())
        self._changed.set()
        self._changed = asyncio.Event()

    async def next(self, known: SourceStatus) -> SourceStatus:
        """Wait until the status is another than `known`, and return it."""
        while self.now == known:
            await self._changed.wait()
        return self.now
