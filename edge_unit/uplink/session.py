# SPDX-License-Identifier: Apache-2.0
"""What holds from one registration at a master to the next."""

from __future__ import annotations

from dataclasses import dataclass, field

from shared.messages import InitializeAnswer, SlotAnswer, UpdateAnswer, Versions
from shared.timebase import ClockOffset, Exchange


@dataclass(eq=False)
class Session:
    """One registration; before the first, `id` is 0.

    Attributes:
        id: the unit's, as the master numbers it.
        sequence: of the update that was sent last.
        master_minor: the minor of the contract that the master speaks.
        clock: how far the master's clock is from this unit's.
        exchange: the times of the last question and answer.
        acknowledged: the seen report that the master is known to hold: its versions and packed bits.
    """

    id: int = 0
    sequence: int = 0
    master_minor: int = 0
    clock: ClockOffset = field(default_factory=ClockOffset)
    exchange: Exchange | None = None
    acknowledged: tuple[Versions, bytes] | None = None

    @classmethod
    def begun(cls, slot: InitializeAnswer | SlotAnswer, sent_at_ns: int, returned_at_ns: int) -> Session:
        """Begin with the answer to a registration that was sent at `sent_at_ns`; it came at `returned_at_ns`."""
        session = cls(id=slot.id, master_minor=slot.contract_minor)
        session.note(sent_at_ns, slot, returned_at_ns)
        return session

    def next_sequence(self) -> int:
        """Number the next update."""
        self.sequence += 1
        return self.sequence

    def note(self, sent_at_ns: int, answer: InitializeAnswer | SlotAnswer | UpdateAnswer, returned_at_ns: int) -> None:
        """Take in the times of a request that was sent at `sent_at_ns`; its answer came at `returned_at_ns`."""
        self.exchange = Exchange(sent_at_ns, answer.received_at_ns, answer.answered_at_ns, returned_at_ns)
        self.clock.add(self.exchange)
