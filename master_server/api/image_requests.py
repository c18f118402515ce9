# SPDX-License-Identifier: Apache-2.0
"""Pictures that someone waits for: each is asked of its unit once, handed to all who wait, and not kept."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from master_server.core import Registry
from master_server.core.units import IMAGE_EXPIRES_S
from shared.clock import NS_PER_S
from shared.errors import Refusal
from shared.messages import DONE, ImageKind, Outcome
from shared.waiting import within

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass
class _Awaited:
    """A picture that a unit was asked for."""

    command_id: int
    expires_at_ns: int
    arrived: asyncio.Event = field(default_factory=asyncio.Event)
    png: bytes | None = None
    outcome: Outcome = DONE


class Pictures:
    """What is awaited of all units: at most one picture of each kind and form a unit."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._awaited: dict[tuple[int, ImageKind, bool], _Awaited] = {}

    async def get(self, unit_id: int, kind: ImageKind, raw: bool, now_ns: int) -> bytes:
        """The PNG of the unit's next frame.

        Raises:
            Refusal: 404, there is no such unit; 409, it cannot, or too much waits for it; 504, it did not come.
        """
        slot = self._registry.get(unit_id)
        key = unit_id, kind, raw
        awaited = self._awaited.get(key)
        if awaited is None or awaited.expires_at_ns <= now_ns:
            awaited = _Awaited(0, now_ns + round(IMAGE_EXPIRES_S * NS_PER_S))

            def end(outcome: Outcome, awaited: _Awaited = awaited) -> None:
                if awaited.png is None and outcome.code != "done":
                    self._end(awaited, outcome)

            awaited.command_id = self._registry.ask(slot, "image", now_ns, kind, raw, end).id
            self._awaited[key] = awaited
        if not await within((awaited.expires_at_ns - now_ns) / NS_PER_S, awaited.arrived.wait()):
            if self._awaited.get(key) is awaited:
                del self._awaited[key]
            raise Refusal(504, f"unit {unit_id}: its picture did not come within {IMAGE_EXPIRES_S:g} s, see GET /units")
        if awaited.png is None:
            raise Refusal(409, f"unit {unit_id}: no picture: {awaited.outcome.sentence}")
        return awaited.png

    def check_awaited(self, unit_id: int, command_id: int) -> None:
        """Raise a Refusal (409) unless someone waits for this picture."""
        self._find(unit_id, command_id)

    def deliver(self, unit_id: int, command_id: int, png: bytes) -> None:
        """A unit sends a picture.

        Raises:
            Refusal: 409, nobody waits for it; 422, it is no PNG.
        """
        awaited = self._find(unit_id, command_id)
        if not png.startswith(PNG_SIGNATURE):
            raise Refusal(422, "body: expected a PNG, got something else")
        awaited.png = png
        self._end(awaited, DONE)

    def _find(self, unit_id: int, command_id: int) -> _Awaited:
        for (asked_of, _, _), awaited in self._awaited.items():
            if asked_of == unit_id and awaited.command_id == command_id:
                return awaited
        raise Refusal(409, f"unit {unit_id}: nobody waits for the picture of command {command_id}")

    def _end(self, awaited: _Awaited, outcome: Outcome) -> None:
        awaited.outcome = outcome
        awaited.arrived.set()
        for key in [key for key, one in self._awaited.items() if one is awaited]:
            del self._awaited[key]
