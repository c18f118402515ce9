# SPDX-License-Identifier: Apache-2.0
"""The units' voxels merged into one map (Algorithm 9), at a cost of what changes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from shared.lattice import Lattice

MAX_WITNESSES = 255
"""Witnesses are counted in uint8: there can be no more units than that."""

NO_KEYS: NDArray[np.uint32] = np.empty(0, dtype=np.uint32)


class MergedMap:
    """Which voxels of a lattice are reported, and by how many units.

    A unit's report replaces its last one in time proportional to the two. The counter is as large as the lattice,
    but only pages of it that were ever touched take memory.
    """

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.revision = 0
        self._witnesses = np.zeros(lattice.cell_count, dtype=np.uint8)
        self._keys: dict[int, NDArray[np.uint32]] = {}
        self._places: dict[int, NDArray[np.intp]] = {}
        self._snapshot: tuple[NDArray[np.uint32], NDArray[np.uint8]] | None = None
        self._reports: dict[int, NDArray[np.uint32]] | None = None

    def replace(self, unit_id: int, keys: NDArray[np.uint32]) -> None:
        """From now on the unit reports `keys` (N,): ascending, each once, below the lattice's cell count."""
        if self._keys.get(unit_id) is keys:
            return
        before = self._places.get(unit_id)
        if before is not None:
            self._witnesses[before] -= 1
        # As numpy's own kind of index, which it would otherwise make of them twice at each use.
        places = keys.astype(np.intp)
        self._witnesses[places] += 1
        self._keys[unit_id], self._places[unit_id] = keys, places
        self._changed()

    def withdraw(self, unit_id: int) -> None:
        """From now on the unit reports nothing; harmless when it did not."""
        if self._keys.pop(unit_id, None) is not None:
            self._witnesses[self._places.pop(unit_id)] -= 1
            self._changed()

    def voxels(self) -> tuple[NDArray[np.uint32], NDArray[np.uint8]]:
        """The keys (M,) uint32 of all voxels reported, ascending, and their witnesses (M,) uint8."""
        if self._snapshot is None:
            keys = _union(list(self._keys.values()))
            self._snapshot = keys, self._witnesses[keys]
        return self._snapshot

    def reports(self) -> Mapping[int, NDArray[np.uint32]]:
        """What each unit reports, by its id."""
        if self._reports is None:
            self._reports = dict(self._keys)
        return self._reports

    def _changed(self) -> None:
        self.revision += 1
        self._snapshot = None
        self._reports = None


def _union(reports: list[NDArray[np.uint32]]) -> NDArray[np.uint32]:
    """All keys, ascending, each once.

    Sorted by hand: numpy.unique takes them through a hash table, which costs eight times as much, and looking through
    the counter would cost more the finer the lattice is, however little stands in it.
    """
    keys = np.concatenate(reports or [NO_KEYS])
    keys.sort()
    first = np.ones(len(keys), np.bool_)
    np.not_equal(keys[1:], keys[:-1], out=first[1:])
    return keys[first]
