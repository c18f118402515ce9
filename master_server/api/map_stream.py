# SPDX-License-Identifier: Apache-2.0
"""The merged map as it changes, for many listeners: latest-only, encoded once for all that use the same format.

A snapshot of the map is made at each change of the master, when a unit or the robot becomes stale, and at each
heartbeat. A listener takes the newest snapshot whenever it is ready for one. Nothing is queued: a slow listener skips
snapshots, costs no memory and delays nobody.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Any, Literal, NamedTuple

from master_server.api.responses import Form, as_json, as_msgpack, map_fields, unseen_fields
from master_server.core import MapView, Readable, UnitState
from shared.clock import NS_PER_MS, stage_ns
from shared.errors import Refusal
from shared.waiting import Clock, LoopClock, Timer

logger = logging.getLogger(__name__)

PERIOD_MIN_NS = 10 * NS_PER_MS
"""Shortest time between snapshots: fifty units at 30 fps report 1,500 times a second, and no robot reads that often."""

HEARTBEAT_NS = 500 * NS_PER_MS
"""A listener without a message for a second knows that the master, or the network to it, is down."""

DUE_SLACK_NS = NS_PER_MS
"""Timers of event loops count in milliseconds; a check before its time would find no change."""

MAX_LISTENERS = 32
"""A robot, a planner, a recorder and some viewers, with room to spare; bounds the cost of a snapshot."""

COST_SHARE_MAX = 0.25
"""Share of the event loop's time: with huge maps in many formats, snapshots become rarer, and updates still pass."""


class StreamFormat(NamedTuple):
    """The format of a listener's messages."""

    form: Form = "indices"
    encoding: Literal["msgpack", "json"] = "msgpack"
    unseen: bool = False


class MapSnapshot:
    """The master's state at one time; encoded on first use in each format."""

    def __init__(
        self,
        number: int,
        now_ns: int,
        view: MapView,
        units: list[UnitState],
        unseen: dict[str, Any] | None,
    ) -> None:
        self.number = number
        self.now_ns = now_ns
        self.cost_ns = 0
        self._view = view
        self._units = units
        self._unseen = unseen
        self._encoded: dict[StreamFormat, bytes | str] = {}

    def encoded(self, stream_format: StreamFormat) -> bytes | str:
        """Return the message: bytes of msgpack, or text of JSON."""
        message = self._encoded.get(stream_format)
        if message is None:
            began_ns = stage_ns()
            fields = map_fields(
                self._view, stream_format.form, self._unseen if stream_format.unseen else None, self.now_ns
            )
            fields |= {"number": self.number, "units": self._units}
            message = as_json(fields).decode() if stream_format.encoding == "json" else as_msgpack(fields)
            self._encoded[stream_format] = message
            self.cost_ns += stage_ns() - began_ns
        return message


class Listener:
    """A subscriber of the stream; a context manager, which unsubscribes at its end."""

    def __init__(self, stream: Stream, stream_format: StreamFormat) -> None:
        self.stream_format = stream_format
        self.sent = 0
        self.skipped = 0
        self._stream = stream
        self._news = asyncio.Event()
        self._last_number = 0

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.forget(self)

    def notify(self) -> None:
        """Signal that there is a newer snapshot."""
        self._news.set()

    async def next(self) -> bytes | str:
        """Wait for a message that this listener has not had, and return the newest."""
        await self._news.wait()
        self._news.clear()
        snapshot = self._stream.snapshot
        assert snapshot is not None
        if self._last_number:
            self.skipped += snapshot.number - self._last_number - 1
        self._last_number = snapshot.number
        self.sent += 1
        return snapshot.encoded(self.stream_format)


class Stream:
    """All listeners of one master, and the timer for changes by time alone; idle without listeners."""

    def __init__(self, master: Readable, clock: Clock | None = None) -> None:
        """By default, `clock` is that of the running event loop."""
        self.snapshot: MapSnapshot | None = None
        self._master = master
        self._clock = LoopClock() if clock is None else clock
        self.listeners: set[Listener] = set()
        self._timer: Timer | None = None
        self._due_ns = 0
        self._taken_at_ns = 0
        self._number = 0
        master.listeners.append(self._changed)

    def __len__(self) -> int:
        return len(self.listeners)

    def stop(self) -> None:
        """Stop the timer."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def listen(self, stream_format: StreamFormat) -> Listener:
        """Add a listener; its first message comes at once.

        Raises:
            Refusal: 503, there are `MAX_LISTENERS` already.
        """
        if len(self.listeners) >= MAX_LISTENERS:
            raise Refusal(503, f"stream: expected at most {MAX_LISTENERS} readers, which are there already; close one")
        listener = Listener(self, stream_format)
        self.listeners.add(listener)
        self._changed()
        return listener

    def forget(self, listener: Listener) -> None:
        """Remove a listener."""
        self.listeners.discard(listener)

    def _changed(self) -> None:
        """Schedule a snapshot as soon as allowed, since something changed."""
        if not self.listeners:
            return
        now_ns = self._clock.now_ns()
        cost_ns = 0 if self.snapshot is None else self.snapshot.cost_ns
        gap_ns = max(PERIOD_MIN_NS, round(cost_ns / COST_SHARE_MAX))
        at_ns = max(now_ns, self._taken_at_ns + gap_ns)
        if self._timer is None or at_ns < self._due_ns:
            self._schedule(at_ns)

    def _schedule(self, at_ns: int) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._due_ns = at_ns
        self._timer = self._clock.call_at(at_ns, self._take_snapshot)

    def _take_snapshot(self) -> None:
        now_ns = self._clock.now_ns()
        self._timer = None
        self._taken_at_ns = now_ns
        if not self.listeners:
            self.snapshot = None
            return
        # Schedule the next one first: a fault below then costs only this snapshot.
        due_ns = self._master.next_change_ns(now_ns)
        at_ns = now_ns + HEARTBEAT_NS
        self._schedule(at_ns if due_ns is None else min(at_ns, due_ns + DUE_SLACK_NS))
        began_ns = stage_ns()
        units = self._master.unit_states(now_ns)
        unseen = None
        if any(listener.stream_format.unseen for listener in self.listeners):
            unseen = unseen_fields(self._master.blocks_at(now_ns), self._master.seen_by(now_ns))
        self._number += 1
        self.snapshot = MapSnapshot(self._number, now_ns, self._master.view(now_ns), units, unseen)
        self.snapshot.cost_ns = stage_ns() - began_ns
        for listener in self.listeners:
            listener.notify()
