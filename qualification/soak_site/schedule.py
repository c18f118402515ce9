# SPDX-License-Identifier: Apache-2.0
"""Times and kinds of faults, drawn from a seed. Equal seeds and durations give equal faults."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass

GAP_S = 1.5
"""Mean time between the beginnings of two faults; several are active at once."""

HOLD_S = (0.2, 4.0)
"""Shortest and longest duration of a fault: from too short to be noticed, to the slowest retries."""


@dataclass(frozen=True)
class Kind:
    """A kind of fault: its target, its relative frequency, and `early` if it occurs only in the first part of a soak.

    A target has one fault at a time. A fault is `early` if it ends a process that must live long.
    """

    target: str
    weight: float = 1.0
    early: bool = False


@dataclass(frozen=True)
class Strike:
    """One fault: its beginning in s from the start of all faults, and its duration in s."""

    at_s: float
    name: str
    hold_s: float


def schedule(kinds: Mapping[str, Kind], seed: str, seconds: float, early: bool) -> list[Strike]:
    """Return faults in the order of their beginnings. Each is over by `seconds`; no target has two at once."""
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
