# SPDX-License-Identifier: Apache-2.0
"""Requests for a unit's images: each image is requested once, sent to all who wait for it, and not stored."""

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
class _PendingImage:
    """An image that was requested from a unit."""

    command_id: int
    expires_at_ns: int
    arrived: asyncio.Event = field(default_factory=asyncio.Event)
    png: bytes | None = None
    outcome: Outcome = DONE


class ImageRequests:
    """Pending images of all units: at most one for each unit, kind and form."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._pending: dict[tuple[int, ImageKind, bool], _PendingImage] = {}

    async def get(self, unit_id: int, kind: ImageKind, raw: bool, now_ns: int) -> bytes:
        """Return the PNG of the unit's next frame.

        Raises:
            Refusal: 404, the unit is unknown; 409, the unit failed, or too many commands wait; 504, no image came.
        """
        slot = self._registry.get(unit_id)
        key = unit_id, kind, raw
        pending = self._pending.get(key)
        if pending is None or pending.expires_at_ns <= now_ns:
            pending = _PendingImage(0, now_ns + round(IMAGE_EXPIRES_S * NS_PER_S))

            def end(outcome: Outcome, pending: _PendingImage = pending) -> None:
                if pending.png is None and outcome.code != "done":
                    self._end(pending, outcome)

            pending.command_id = self._registry.send_command(slot, "image", now_ns, kind, raw, end).id
            self._pending[key] = pending
        if not await within((pending.expires_at_ns - now_ns) / NS_PER_S, pending.arrived.wait()):
            if self._pending.get(key) is pending:
                del self._pending[key]
            raise Refusal(504, f"unit {unit_id}: its image did not come within {IMAGE_EXPIRES_S:g} s, see GET /units")
        if pending.png is None:
            raise Refusal(409, f"unit {unit_id}: no image: {pending.outcome.sentence}")
        return pending.png

    def check_pending(self, unit_id: int, command_id: int) -> None:
        """Raise a Refusal (409) if no request waits for this image."""
        self._find(unit_id, command_id)

    def deliver(self, unit_id: int, command_id: int, png: bytes) -> None:
        """Store the image that a unit sends.

        Raises:
            Refusal: 409, no request waits for it; 422, it is no PNG.
        """
        pending = self._find(unit_id, command_id)
        if not png.startswith(PNG_SIGNATURE):
            raise Refusal(422, "body: expected a PNG, got something else")
        pending.png = png
        self._end(pending, DONE)

    def _find(self, unit_id: int, command_id: int) -> _PendingImage:
        for (requested_of, _, _), pending in self._pending.items():
            if requested_of == unit_id and pending.command_id == command_id:
                return pending
        raise Refusal(409, f"unit {unit_id}: no request waits for the image of command {command_id}")

    def _end(self, pending: _PendingImage, outcome: Outcome) -> None:
        pending.outcome = outcome
        pending.arrived.set()
        for key in [key for key, one in self._pending.items() if one is pending]:
            del self._pending[key]
