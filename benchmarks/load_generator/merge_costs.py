# SPDX-License-Identifier: Apache-2.0
"""Cost of the merge itself in this process, by the number of units: no network, no HTTP."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np

from benchmarks.load_generator.load import FRAME_RATE_HZ
from benchmarks.load_generator.traffic import VIEWS, view
from master_server.api.responses import as_msgpack, map_fields
from master_server.core import MapView, MergedMap
from shared.cell import Cell
from shared.clock import NS_PER_US, stage_ns
from shared.settings import Settings
from shared.wire import keys_from_bytes
from simulation.world.world import DEMO_CELL

REPEATS = 100


@dataclass(frozen=True)
class MergeCost:
    """Median times: to merge one unit's report, to rebuild the union of all after it, and to encode it for a robot."""

    units: int
    map_voxels: int
    merge_us: float
    union_us: float
    answer_us: float


def merge_costs(units: Sequence[int], voxels: int) -> Iterator[MergeCost]:
    """Measure one number of units after the other, with people of `voxels` voxels."""
    cell, settings = Cell.load(DEMO_CELL), Settings()
    lattice, blocks = cell.lattice(settings.voxel_size_m), cell.lattice(settings.seen_block_size_m)
    views = [view(n, voxels, lattice, blocks, FRAME_RATE_HZ) for n in range(VIEWS)]
    for size in units:
        merged = MergedMap(lattice)
        steps = count()

        def merge(merged: MergedMap = merged, size: int = size, steps: Iterator[int] = steps) -> None:
            step = next(steps)
            keys = views[step % size % VIEWS].keys
            merged.replace(step % size, keys_from_bytes(keys[(step // size + 11 * (step % size)) % len(keys)], 2**32))

        def union(merged: MergedMap = merged) -> None:
            merged.voxels()

        def answer(merged: MergedMap = merged) -> None:
            view = MapView(lattice, 1, *merged.voxels(), (), 0.0, 1)
            as_msgpack(map_fields(view, "indices", None, 0))

        for _ in range(size):
            merge()
        took_us = [(_took_us(merge), _took_us(union), _took_us(answer)) for _ in range(REPEATS)]
        yield MergeCost(size, len(merged.voxels()[0]), *np.median(took_us, axis=0).tolist())


def _took_us(work: Callable[[], None]) -> float:
    began_ns = stage_ns()
    work()
    return (stage_ns() - began_ns) / NS_PER_US
