# SPDX-License-Identifier: Apache-2.0
"""What happens to a cell when, drawn from a seed: the same seed and time, the same faults."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass

GAP_S = 1.5
"""Between the beginnings of two faults, on average: several are on at once."""

HOLD_S = (0.2, 4.0)
"""How long one lasts: from too short to be noticed, to retries at their slowest."""


@dataclass(frozen=True)
class Kind:
    """A sort of fault: what it strikes (one at a time), how often, and whether only in the beginning of a soak.

    What ends a process that is to live long does so only then.
    """

    target: str
    weight: float = 1.0
    early: bool = False


@dataclass(frozen=True)
class Strike:
    """One fault: when it begins, in s from the start of the faults, and how long it lasts."""

    at_s: float
    name: str
    hold_s: float


def schedule(kinds: Mapping[str, Kind], seed: str, seconds: float, early: bool) -> list[Strike]:
    """Faults in the order of their beginnings, each over by `seconds`; no target is struck twice at once."""
    draw = random.Random(seed)
    free_s: dict[str, float] = {}
    found: list[Strike] = []
    at_s = 0.0
    while (at_s := at_s + draw.expovariate(1.0 / GAP_S)) < seconds:
        hold_s = draw.uniform(*HOLD_S)
        names = [
            name for name, kind in kinds.items() if free_s.get(kind.target, 0.0) <= at_s and (early or not kind.early)
        ]
        if not names or at_s + hold_s > seconds:
            continue
        (name,) = draw.choices(names, [kinds[name].weight for name in names])
        free_s[kinds[name].target] = at_s + hold_s
        found.append(Strike(round(at_s, 3), name, round(hold_s, 3)))
    return found
