# SPDX-License-Identifier: Apache-2.0
"""Compare the map with a slow model: the answer for a time depends on the reports only, not on earlier reads."""

from __future__ import annotations

from collections import Counter

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from tests.master_server.fakes import AT_ORIGIN, MS, START_NS, FakeUnit, S, joined, master, sees_all

STALE_AFTER_S = 1.0
AGE_NS = 30 * MS
UNITS = st.integers(1, 3)
KEYS = st.sets(st.integers(0, 7999), max_size=8)


class ViewMachine(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.master = master(stale_after_s=STALE_AFTER_S)
        self.now_ns = START_NS
        self.units: dict[int, FakeUnit] = {}
        self.reports: dict[int, tuple[set[int], int]] = {}

    def teardown(self) -> None:
        self.master.store.close()

    def expected(self, now_ns: int) -> dict[int, int]:
        """Return the voxels of units whose last frame is fresh, and the number of these that report each."""
        return Counter(
            key
            for keys, captured_ns in self.reports.values()
            if now_ns - captured_ns <= STALE_AFTER_S * S
            for key in keys
        )

    @rule(number=UNITS, keys=KEYS)
    def report(self, number: int, keys: set[int]) -> None:
        if number not in self.units:
            self.units[number] = joined(self.master, number, self.now_ns)
        self.units[number].update(self.now_ns, keys, seen=sees_all(self.master), age_ns=AGE_NS)
        self.reports[number] = keys, self.now_ns - AGE_NS

    @precondition(lambda self: self.units)
    @rule(data=st.data())
    def register_anew(self, data: st.DataObject) -> None:
        number = data.draw(st.sampled_from(sorted(self.units)))
        self.units[number].initialize(self.now_ns)
        self.reports.pop(number, None)

    @precondition(lambda self: self.units)
    @rule(data=st.data())
    def find_elsewhere(self, data: st.DataObject) -> None:
        number = data.draw(st.sampled_from(sorted(self.units)))
        unit = self.units[number]
        version = self.master.set_pose(unit.initialized.id, AT_ORIGIN, "board", None)
        unit.versions = unit.versions.model_copy(update={"pose": version})
        self.reports.pop(number, None)

    @precondition(lambda self: self.units)
    @rule(data=st.data())
    def forget(self, data: st.DataObject) -> None:
        number = data.draw(st.sampled_from(sorted(self.units)))
        self.master.forget(self.units.pop(number).initialized.id)
        self.reports.pop(number, None)

    @rule(seconds=st.sampled_from((0.01, 0.5, 0.97, 1.1)))
    def wait(self, seconds: float) -> None:
        self.now_ns += round(seconds * S)

    @rule()
    def tick(self) -> None:
        self.master.tick(self.now_ns)

    @invariant()
    def equals_the_model_at_any_time(self) -> None:
        told = {slot.id: slot.logged_state for slot in self.master.registry}
        for now_ns in (self.now_ns, self.now_ns + round(0.5 * S), self.now_ns + 60 * S, self.now_ns):
            view = self.master.view(now_ns)
            assert dict(zip(view.keys.tolist(), view.witnesses.tolist(), strict=True)) == self.expected(now_ns)
            rows = {row.ip: row for row in self.master.units(now_ns)}
            assert {ip: row.voxels for ip, row in rows.items()} == {
                unit.ip: len(self.reports.get(number, ((), 0))[0]) for number, unit in self.units.items()
            }
            live = [row.id for row in rows.values() if row.state == "live"]
            assert (view.units_live, sorted(view.reports)) == (len(live), sorted(live))
            assert self.master.seen_by(now_ns).max() == len(live)
            assert view.complete == (0 < len(live) == len(self.units))
        assert told == {slot.id: slot.logged_state for slot in self.master.registry}


TestViewMachine = ViewMachine.TestCase
TestViewMachine.settings = settings(max_examples=40, stateful_step_count=25, deadline=None)
