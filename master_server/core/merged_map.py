# SPDX-License-Identifier: Apache-2.0
"""The voxels of all units, stored once and merged into one map on demand (Algorithm 9)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.lattice import Lattice

MAX_WITNESSES = 255
"""Witnesses are counted in uint8, which bounds the number of units."""

NO_KEYS: NDArray[np.uint32] = np.empty(0, dtype=np.uint32)


class _Merged(NamedTuple):
    """The union of the reports of some units, and the ids of these units; valid for one `revision` only."""

    revision: int
    unit_ids: tuple[int, ...]
    keys: NDArray[np.uint32]
    witnesses: NDArray[np.uint8]


class MergedMap:
    """The last report of each unit on a lattice, and the union of any of these reports.

    The union is computed only when it is needed. It is cached for the next request with the same units.
    """

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.revision = 0
        self._keys: dict[int, NDArray[np.uint32]] = {}
        self._merged = _Merged(0, (), NO_KEYS, np.empty(0, np.uint8))

    def replace(self, unit_id: int, keys: NDArray[np.uint32]) -> None:
        """Store the unit's report `keys` (N,): ascending, each once, below the lattice's cell count."""
        if self._keys.get(unit_id) is not keys:
            self._keys[unit_id] = keys
            self.revision += 1

    def withdraw(self, unit_id: int) -> None:
        """Remove the unit's report, if there is one."""
        if self._keys.pop(unit_id, None) is not None:
            self.revision += 1

    def keys_of(self, unit_id: int) -> NDArray[np.uint32]:
        """Return the last report of the unit (N,); empty if it has none."""
        return self._keys.get(unit_id, NO_KEYS)

    def voxels(self, unit_ids: Iterable[int] | None = None) -> tuple[NDArray[np.uint32], NDArray[np.uint8]]:
        """Return the keys (M,) uint32 that these units report, ascending, and the number of units for each, (M,) uint8.

        Without `unit_ids`, all units count.
        """
        ids = tuple(self._keys if unit_ids is None else unit_ids)
        if (self._merged.revision, self._merged.unit_ids) != (self.revision, ids):
            self._merged = _Merged(self.revision, ids, *_union([self.keys_of(unit_id) for unit_id in ids]))
        return self._merged.keys, self._merged.witnesses

    def reports(self, unit_ids: Iterable[int] | None = None) -> Mapping[int, NDArray[np.uint32]]:
        """Return the report of each of these units by its id; without `unit_ids`, the reports of all units."""
        return {unit_id: self.keys_of(unit_id) for unit_id in (self._keys if unit_ids is None else unit_ids)}


def _union(reports: list[NDArray[np.uint32]]) -> tuple[NDArray[np.uint32], NDArray[np.uint8]]:
    """Return all keys, ascending, each once, and the number of reports that contain each.

    This sorts the keys itself: numpy.unique uses a hash table, which takes eight times as long. It counts in the sorted
    keys: a counter for each cell of the lattice would cost more with each report than the report itself.
    """
    keys = np.concatenate(reports or [NO_KEYS])
    keys.sort()
    # One more entry than there are keys: the end of the last key.
    first = np.ones(len(keys) + 1, np.bool_)
    np.not_equal(keys[1:], keys[:-1], out=first[1:-1])
    begins = np.flatnonzero(first)
    return keys[begins[:-1]], np.diff(begins).astype(np.uint8)
