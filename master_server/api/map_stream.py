# SPDX-License-Identifier: Apache-2.0
"""The merged map as it changes, for many listeners: the newest only, encoded once for all who want the same.

A change of the master, the moment at which a unit or the robot becomes stale, and a heartbeat each make a picture of
the map; a listener takes the newest one whenever it is ready for it. Nothing is queued, so that a slow listener skips
pictures, costs no memory and delays nobody.
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
"""Pictures are at least this far apart: fifty units at 30 fps report 1,500 times a second, and no robot reads that."""

HEARTBEAT_NS = 500 * NS_PER_MS
"""A listener that hears nothing for a second knows that the master, or the way to it, is gone."""

DUE_SLACK_NS = NS_PER_MS
"""Timers of event loops count in milliseconds; a look before its time would find nothing changed."""

MAX_LISTENERS = 32
"""A robot, a planner, a recorder and some viewers, with room to spare; bounds what each picture costs."""

COST_SHARE_MAX = 0.25
"""Of the event loop's time: with huge maps in many forms pictures become rarer, and updates still pass."""


class Wish(NamedTuple):
    """How a listener wants its messages."""

    form: Form = "indices"
    encoding: Literal["msgpack", "json"] = "msgpack"
    unseen: bool = False


class Picture:
    """What the master knew at one time; encoded when somebody first wants it so."""

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
        self._encoded: dict[Wish, bytes | str] = {}

    def encoded(self, wish: Wish) -> bytes | str:
        """The message: bytes of msgpack, or text of JSON."""
        message = self._encoded.get(wish)
        if message is None:
            began_ns = stage_ns()
            fields = map_fields(self._view, wish.form, self._unseen if wish.unseen else None, self.now_ns)
            fields |= {"number": self.number, "units": self._units}
            message = as_json(fields).decode() if wish.encoding == "json" else as_msgpack(fields)
            self._encoded[wish] = message
            self.cost_ns += stage_ns() - began_ns
        return message


class Listener:
    """One who listens; a context, after which it is forgotten."""

    def __init__(self, stream: Stream, wish: Wish) -> None:
        self.wish = wish
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
        """There is a newer picture."""
        self._news.set()

    async def next(self) -> bytes | str:
        """The newest message, as soon as there is one that this listener has not had."""
        await self._news.wait()
        self._news.clear()
        picture = self._stream.picture
        assert picture is not None
        if self._last_number:
            self.skipped += picture.number - self._last_number - 1
        self._last_number = picture.number
        self.sent += 1
        return picture.encoded(self.wish)


class Stream:
    """All listeners of one master, and the timer that looks when nobody reports; it rests while nobody listens."""

    def __init__(self, master: Readable, clock: Clock | None = None) -> None:
        """`clock` is that of the running event loop by default."""
        self.picture: Picture | None = None
        self._master = master
        self._clock = LoopClock() if clock is None else clock
        self.listeners: set[Listener] = set()
        self._timer: Timer | None = None
        self._due_ns = 0
        self._looked_at_ns = 0
        self._number = 0
        master.listeners.append(self._changed)

    def __len__(self) -> int:
        return len(self.listeners)

    def stop(self) -> None:
        """Look no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def listen(self, wish: Wish) -> Listener:
        """From now on somebody listens; its first message comes at once.

        Raises:
            Refusal: 503, there are `MAX_LISTENERS` already.
        """
        if len(self.listeners) >= MAX_LISTENERS:
            raise Refusal(503, f"stream: {MAX_LISTENERS} readers listen already")
        listener = Listener(self, wish)
        self.listeners.add(listener)
        self._changed()
        return listener

    def forget(self, listener: Listener) -> None:
        """Somebody listens no more."""
        self.listeners.discard(listener)

    def _changed(self) -> None:
        """Something is another; look as soon as may be."""
        if not self.listeners:
            return
        now_ns = self._clock.now_ns()
        cost_ns = 0 if self.picture is None else self.picture.cost_ns
        gap_ns = max(PERIOD_MIN_NS, round(cost_ns / COST_SHARE_MAX))
        at_ns = max(now_ns, self._looked_at_ns + gap_ns)
        if self._timer is None or at_ns < self._due_ns:
            self._look_at(at_ns)

    def _look_at(self, at_ns: int) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._due_ns = at_ns
        self._timer = self._clock.call_at(at_ns, self._look)

    def _look(self) -> None:
        now_ns = self._clock.now_ns()
        self._timer = None
        self._looked_at_ns = now_ns
        if not self.listeners:
            self.picture = None
            return
        # First of all, so that even a fault below only costs this one picture.
        due_ns = self._master.next_change_ns(now_ns)
        at_ns = now_ns + HEARTBEAT_NS
        self._look_at(at_ns if due_ns is None else min(at_ns, due_ns + DUE_SLACK_NS))
        began_ns = stage_ns()
        units = self._master.unit_states(now_ns)
        unseen = None
        if any(listener.wish.unseen for listener in self.listeners):
            unseen = unseen_fields(self._master.blocks_at(now_ns), self._master.seen_by(now_ns))
        self._number += 1
        self.picture = Picture(self._number, now_ns, self._master.view(now_ns), units, unseen)
        self.picture.cost_ns = stage_ns() - began_ns
        for listener in self.listeners:
            listener.notify()
