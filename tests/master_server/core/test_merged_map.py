# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import Counter

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from numpy.typing import NDArray

from master_server.core import MergedMap
from shared.lattice import Lattice

LATTICE = Lattice((0.0, 0.0, 0.0), 0.1, (4, 5, 6))

UNITS = st.integers(1, 4)


def keys(*values: int) -> NDArray[np.uint32]:
    return np.array(sorted(values), dtype=np.uint32)


def content(merged: MergedMap, *unit_ids: int) -> dict[int, int]:
    found, witnesses = merged.voxels(unit_ids or None)
    assert (np.diff(found.astype(np.int64)) > 0).all()
    return dict(zip(found.tolist(), witnesses.tolist(), strict=True))


def test_voxels_of_all_units_are_united_and_witnesses_counted() -> None:
    merged = MergedMap(LATTICE)
    merged.replace(1, keys(1, 2, 3))
    merged.replace(2, keys(3, 119))
    assert content(merged) == {1: 1, 2: 1, 3: 2, 119: 1}


def test_a_report_replaces_the_one_before() -> None:
    merged = MergedMap(LATTICE)
    merged.replace(1, keys(1, 2))
    merged.replace(2, keys(2))
    merged.replace(1, keys(5))
    assert content(merged) == {2: 1, 5: 1}
    merged.replace(1, keys())
    assert content(merged) == {2: 1}


def test_withdrawing_takes_out_one_unit_only() -> None:
    merged = MergedMap(LATTICE)
    merged.replace(1, keys(1, 2))
    merged.replace(2, keys(2))
    merged.withdraw(1)
    merged.withdraw(1)
    merged.withdraw(7)
    assert content(merged) == {2: 1}


def test_a_crowded_lattice_and_an_empty_one_are_united_alike() -> None:
    vast = Lattice((0.0, 0.0, 0.0), 0.1, (40, 50, 60))
    for reported in (150, vast.cell_count // 50):
        merged = MergedMap(vast)
        merged.replace(1, keys(*range(0, 3 * reported, 3)))
        merged.replace(2, keys(*range(0, 2 * reported, 2)))
        assert content(merged) == Counter([*range(0, 3 * reported, 3), *range(0, 2 * reported, 2)])


def test_the_reports_of_each_unit_are_available() -> None:
    merged = MergedMap(LATTICE)
    merged.replace(1, keys(1, 2))
    merged.replace(2, keys(2))
    before = merged.reports()
    merged.replace(1, keys(7))
    assert {unit_id: found.tolist() for unit_id, found in before.items()} == {1: [1, 2], 2: [2]}
    merged.withdraw(2)
    assert {unit_id: found.tolist() for unit_id, found in merged.reports().items()} == {1: [7]}


def test_the_union_of_some_leaves_the_others_out() -> None:
    merged = MergedMap(LATTICE)
    merged.replace(1, keys(1, 2))
    merged.replace(2, keys(2, 3))
    for _ in range(2):
        assert content(merged, 2) == {2: 1, 3: 1}
        assert content(merged) == {1: 1, 2: 2, 3: 1}
    assert content(merged, 7) == {}
    assert merged.keys_of(7).size == 0
    assert {unit_id: found.tolist() for unit_id, found in merged.reports((2, 7)).items()} == {2: [2, 3], 7: []}


def test_an_empty_map_has_no_voxels() -> None:
    assert content(MergedMap(LATTICE)) == {}


def test_the_revision_rises_only_with_a_change() -> None:
    merged = MergedMap(LATTICE)
    mine = keys(1)
    merged.replace(1, mine)
    revision = merged.revision
    merged.replace(1, mine)
    merged.withdraw(2)
    merged.voxels()
    assert merged.revision == revision
    merged.withdraw(1)
    assert merged.revision > revision


REPORT = st.one_of(st.none(), st.sets(st.integers(0, LATTICE.cell_count - 1), max_size=30))


@given(st.lists(st.tuples(st.integers(1, 4), REPORT), max_size=40))
def test_any_history_equals_a_recount(history: list[tuple[int, set[int] | None]]) -> None:
    merged = MergedMap(LATTICE)
    reports: dict[int, set[int]] = {}
    for unit_id, report in history:
        if report is None:
            merged.withdraw(unit_id)
            reports.pop(unit_id, None)
        else:
            merged.replace(unit_id, keys(*report))
            reports[unit_id] = report
        assert content(merged) == dict(Counter(key for keys_of in reports.values() for key in keys_of))


class MergeMachine(RuleBasedStateMachine):
    """Compare the merged map with a slow model of plain sets."""

    def __init__(self) -> None:
        super().__init__()
        self.map = MergedMap(LATTICE)
        self.twin: dict[int, set[int]] = {}
        self.arrays: dict[int, NDArray[np.uint32]] = {}
        self.revision = 0

    @rule(unit=UNITS, keys=st.sets(st.integers(0, LATTICE.cell_count - 1), max_size=30))
    def report(self, unit: int, keys: set[int]) -> None:
        self.arrays[unit] = np.array(sorted(keys), np.uint32)
        self.map.replace(unit, self.arrays[unit])
        self.twin[unit] = keys
        self.revision += 1

    @rule(unit=UNITS)
    def report_the_same_array(self, unit: int) -> None:
        if unit in self.arrays:
            self.map.replace(unit, self.arrays[unit])
            self.revision += unit not in self.twin
            self.twin[unit] = set(self.arrays[unit].tolist())

    @rule(unit=UNITS)
    def withdraw(self, unit: int) -> None:
        self.map.withdraw(unit)
        self.revision += self.twin.pop(unit, None) is not None

    @rule(units=st.sets(UNITS))
    def union_of_some(self, units: set[int]) -> None:
        keys, witnesses = self.map.voxels(sorted(units))
        counts = Counter(key for unit in units for key in self.twin.get(unit, ()))
        assert dict(zip(keys.tolist(), witnesses.tolist(), strict=True)) == counts

    @invariant()
    def equals_the_sets(self) -> None:
        keys, witnesses = self.map.voxels()
        counts = Counter(key for reported in self.twin.values() for key in reported)
        assert keys.tolist() == sorted(counts)
        assert witnesses.tolist() == [counts[key] for key in sorted(counts)]
        assert self.map.revision == self.revision


TestMergeMachine = MergeMachine.TestCase
TestMergeMachine.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
