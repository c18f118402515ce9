# SPDX-License-Identifier: Apache-2.0
"""The state of a session, from one registration at a master to the next."""

from __future__ import annotations

from dataclasses import dataclass, field

from shared.messages import InitializeAnswer, SlotAnswer, UpdateAnswer, Versions
from shared.timebase import ClockOffset, Exchange


@dataclass(eq=False)
class Session:
    """One registration. `id` is 0 before the first one.

    Attributes:
        id: the number that the master gave the unit.
        sequence: the sequence number of the last update.
        master_minor: the minor version of the master's contract.
        clock: the estimated offset of the master's clock from the unit's clock.
        exchange: the times of the last request and its answer.
        acknowledged: versions and packed bits of the seen report that the master has confirmed.
    """

    id: int = 0
    sequence: int = 0
    master_minor: int = 0
    clock: ClockOffset = field(default_factory=ClockOffset)
    exchange: Exchange | None = None
    acknowledged: tuple[Versions, bytes] | None = None

    @classmethod
    def begun(cls, slot: InitializeAnswer | SlotAnswer, sent_at_ns: int, returned_at_ns: int) -> Session:
        """Return the session of a registration that was sent at `sent_at_ns`. Its answer came at `returned_at_ns`."""
        session = cls(id=slot.id, master_minor=slot.contract_minor)
        session.note(sent_at_ns, slot, returned_at_ns)
        return session

    def next_sequence(self) -> int:
        """Return the sequence number of the next update."""
        self.sequence += 1
        return self.sequence

    def note(self, sent_at_ns: int, answer: InitializeAnswer | SlotAnswer | UpdateAnswer, returned_at_ns: int) -> None:
        """Add the times of a request that was sent at `sent_at_ns`. Its answer came at `returned_at_ns`."""
        self.exchange = Exchange(sent_at_ns, answer.received_at_ns, answer.answered_at_ns, returned_at_ns)
        self.clock.add(self.exchange)
