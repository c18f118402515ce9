# SPDX-License-Identifier: Apache-2.0
"""The units' voxels, kept once, and merged into one map when somebody asks (Algorithm 9)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.lattice import Lattice

MAX_WITNESSES = 255
"""Witnesses are counted in uint8: there can be no more units than that."""

NO_KEYS: NDArray[np.uint32] = np.empty(0, dtype=np.uint32)


class _Merged(NamedTuple):
    """The union of some units' reports, and of which; void once `revision` is another."""

    revision: int
    unit_ids: tuple[int, ...]
    keys: NDArray[np.uint32]
    witnesses: NDArray[np.uint8]


class MergedMap:
    """What each unit reported last on a lattice, and the union of any of these reports.

    A report costs nothing until somebody asks for the union, which is kept for the next who asks for the same one.
    """

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.revision = 0
        self._keys: dict[int, NDArray[np.uint32]] = {}
        self._merged = _Merged(0, (), NO_KEYS, np.empty(0, np.uint8))

    def replace(self, unit_id: int, keys: NDArray[np.uint32]) -> None:
        """From now on the unit reports `keys` (N,): ascending, each once, below the lattice's cell count."""
        if self._keys.get(unit_id) is not keys:
            self._keys[unit_id] = keys
            self.revision += 1

    def withdraw(self, unit_id: int) -> None:
        """From now on the unit reports nothing; harmless when it did not."""
        if self._keys.pop(unit_id, None) is not None:
            self.revision += 1

    def keys_of(self, unit_id: int) -> NDArray[np.uint32]:
        """What the unit reported last (N,); empty when it reports nothing."""
        return self._keys.get(unit_id, NO_KEYS)

    def voxels(self, unit_ids: Iterable[int] | None = None) -> tuple[NDArray[np.uint32], NDArray[np.uint8]]:
        """The keys (M,) uint32 that these units report, ascending, and how many of them report each (M,) uint8.

        Without `unit_ids`, those of all units.
        """
        ids = tuple(self._keys if unit_ids is None else unit_ids)
        if (self._merged.revision, self._merged.unit_ids) != (self.revision, ids):
            self._merged = _Merged(self.revision, ids, *_union([self.keys_of(unit_id) for unit_id in ids]))
        return self._merged.keys, self._merged.witnesses

    def reports(self, unit_ids: Iterable[int] | None = None) -> Mapping[int, NDArray[np.uint32]]:
        """What each of these units reports, by its id; without `unit_ids`, what all do."""
        return {unit_id: self.keys_of(unit_id) for unit_id in (self._keys if unit_ids is None else unit_ids)}


def _union(reports: list[NDArray[np.uint32]]) -> tuple[NDArray[np.uint32], NDArray[np.uint8]]:
    """All keys, ascending, each once, and how often each is reported.

    Sorted by hand: numpy.unique takes them through a hash table, which costs eight times as much. Counted in what was
    sorted: a counter as large as the lattice had to be kept right with each report, at more than the report itself.
    """
    keys = np.concatenate(reports or [NO_KEYS])
    keys.sort()
    # One more than there are keys: where the last one ends.
    first = np.ones(len(keys) + 1, np.bool_)
    np.not_equal(keys[1:], keys[:-1], out=first[1:-1])
    begins = np.flatnonzero(first)
    return keys[begins[:-1]], np.diff(begins).astype(np.uint8)
