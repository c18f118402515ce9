# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from master_server.core import Master
from master_server.core.units import COMMAND_EXPIRES_S, FPS_FRAMES, MAX_UNITS
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.errors import InputError, Refusal, WireError
from shared.lattice import Lattice
from shared.messages import (
    CONTRACT_VERSION,
    DONE,
    MAX_COMMANDS,
    CommandRow,
    Ended,
    Health,
    JointsRequest,
    Matrix,
    Outcome,
    PoseOrigin,
    Progress,
    UnitRow,
    Verb,
    Versions,
)
from shared.settings import Settings
from shared.timebase import Exchange
from tests.master_server.fakes import AT_ORIGIN, GOOD, MS, START_NS, FakeUnit, S, joined, master, sees_all

NOW_NS = START_NS + S
LATER_NS = NOW_NS + 60 * S
"""A unit that reported at `NOW_NS` and never since is silent by then."""


def shown(one: Master, now_ns: int = NOW_NS) -> dict[int, int]:
    view = one.view(now_ns)
    return dict(zip(view.keys.tolist(), view.witnesses.tolist(), strict=True))


def state(one: Master, unit: FakeUnit, now_ns: int = NOW_NS) -> tuple[str, str]:
    row = next(row for row in one.units(now_ns) if row.id == unit.initialized.id)
    return row.state, row.reason


def live(one: Master, number: int = 1, *keys: int) -> FakeUnit:
    """Return a unit that has just reported and sees everything."""
    unit = joined(one, number)
    unit.update(NOW_NS, keys, seen=sees_all(one))
    assert state(one, unit) == ("live", "")
    return unit


# ---------------------------------------------------------------------- slots (Algorithm 8)


def test_an_ip_has_one_slot() -> None:
    one = master()
    first = joined(one)
    again = joined(one)
    other = joined(one, 2)
    assert first.initialized.id == again.initialized.id != other.initialized.id
    assert first.initialized.session != again.initialized.session
    assert len(one.units(NOW_NS)) == 2


def test_a_restarted_unit_keeps_its_pose_and_reports_from_its_first_update() -> None:
    one = master()
    live(one, 1, 5)
    unit = FakeUnit(one, serial="S1")
    answer = unit.initialize(NOW_NS, pose=None)
    assert answer.T_world_camera == AT_ORIGIN
    assert shown(one) == {}
    assert state(one, unit)[0] == "stale"
    unit.update(NOW_NS + MS, [6])
    assert shown(one) == {6: 1}


def test_another_camera_in_a_slot_voids_its_pose_and_says_so() -> None:
    one = master()
    live(one, 1, 5)
    other = FakeUnit(one, ip="10.0.0.1", serial="B")
    assert other.initialize(LATER_NS, pose=None).T_world_camera is None
    assert state(one, other) == ("uncalibrated", "the camera changed from S1 to B, so its pose is void")
    other.update(NOW_NS, [5])
    assert shown(one) == {}
    assert not one.view(NOW_NS).complete


def test_a_camera_at_a_new_ip_retires_its_old_slot() -> None:
    one = master()
    live(one, 1, 5)
    moved = FakeUnit(one, ip="10.0.0.9", serial="S1", boot_id="another boot")
    assert moved.initialize(LATER_NS, pose=None).T_world_camera is None
    assert [row.ip for row in one.units(NOW_NS)] == ["10.0.0.9"]
    assert shown(one) == {}


def test_a_camera_that_lost_its_address_is_missing_until_it_returns() -> None:
    one = master()
    live(one, 1, 5)
    live(one, 2, 6)
    first = FakeUnit(one, ip="10.0.0.2", serial="S1", boot_id="another boot")
    first.initialize(LATER_NS)
    first.update(LATER_NS + MS, [7])
    assert shown(one, LATER_NS + MS) == {7: 1}
    reason = one.view(LATER_NS + MS).reasons[0]
    assert reason.startswith("unit 1 (10.0.0.1) is uncalibrated: camera S1 is at 10.0.0.2 now, where camera S2 was")
    second = FakeUnit(one, ip="10.0.0.1", serial="S2", boot_id="another boot")
    assert second.initialize(LATER_NS + 2 * MS, pose=None).T_world_camera is None
    second.initialize(LATER_NS + 3 * MS)
    second.update(LATER_NS + 4 * MS, [8])
    assert [(row.ip, row.serial) for row in one.units(LATER_NS)] == [("10.0.0.1", "S2"), ("10.0.0.2", "S1")]
    assert shown(one, LATER_NS + 4 * MS) == {7: 1, 8: 1}


def test_a_camera_that_does_not_come_back_may_be_deleted_or_come_elsewhere() -> None:
    one = master()
    live(one, 1, 5)
    live(one, 2, 6)
    FakeUnit(one, ip="10.0.0.2", serial="S1", boot_id="another boot").initialize(LATER_NS)
    FakeUnit(one, ip="10.0.0.9", serial="S2", boot_id="another boot").initialize(LATER_NS)
    assert [(row.ip, row.serial) for row in one.units(LATER_NS)] == [("10.0.0.2", "S1"), ("10.0.0.9", "S2")]


def test_a_new_address_within_one_boot_keeps_the_pose() -> None:
    one = master()
    live(one, 1, 5)
    moved = FakeUnit(one, ip="10.0.0.9", serial="S1")
    assert moved.initialize(LATER_NS, pose=None).T_world_camera == AT_ORIGIN


def test_two_cameras_of_one_serial_do_not_evict_each_other() -> None:
    one = master()
    first = live(one, 1, 5)
    twin = FakeUnit(one, ip="10.0.0.9", serial="S1")
    with pytest.raises(Refusal, match=r"camera S1 reports from IP 10\.0\.0\.1 .*at this moment") as caught:
        twin.initialize(NOW_NS + 100 * MS)
    assert caught.value.status == 409
    assert [row.ip for row in one.units(NOW_NS)] == ["10.0.0.1"]
    first.update(NOW_NS + 200 * MS, [6])
    assert shown(one, NOW_NS + 200 * MS) == {6: 1}


def test_the_number_of_slots_is_bounded() -> None:
    one = master()
    for number in range(MAX_UNITS):
        joined(one, number)
    with pytest.raises(Refusal, match=str(MAX_UNITS)) as caught:
        joined(one, MAX_UNITS + 1)
    assert caught.value.status == 503
    # A camera that moves brings its own slot.
    FakeUnit(one, ip="10.0.1.1", serial="S3").initialize()
    assert len(one.units(NOW_NS)) == MAX_UNITS


def test_another_contract_is_refused() -> None:
    one = master()
    with pytest.raises(Refusal, match=f"the unit {CONTRACT_VERSION + 1}.*update the master first"):
        one.initialize(FakeUnit(one).introduction(NOW_NS, contract=CONTRACT_VERSION + 1), "10.0.0.1", NOW_NS)
    assert one.units(NOW_NS) == []


@pytest.mark.parametrize(
    ("changes", "ip", "status"),
    [
        ({"id": 999}, "10.0.0.1", 404),
        ({}, "10.0.0.2", 403),
        ({"session": 12345}, "10.0.0.1", 409),
        ({"sequence": 1}, "10.0.0.1", 409),
    ],
)
def test_foreign_and_old_updates_are_refused(changes: dict[str, Any], ip: str, status: int) -> None:
    one = master()
    unit = live(one, 1, 5)
    request = unit.request(NOW_NS, [6], **changes)
    with pytest.raises(Refusal) as caught:
        one.update(request, ip, NOW_NS)
    assert caught.value.status == status
    assert shown(one) == {5: 1}


def test_a_forgotten_unit_must_initialize_again() -> None:
    one = master()
    unit = live(one, 1, 5)
    one.forget(unit.initialized.id)
    assert one.units(NOW_NS) == []
    assert shown(one) == {}
    with pytest.raises(Refusal) as caught:
        unit.update(NOW_NS)
    assert caught.value.status == 404
    with pytest.raises(Refusal):
        one.forget(unit.initialized.id)
    assert joined(one).initialized.id != unit.initialized.id


# ---------------------------------------------------------------------- merge and freshness (Algorithm 9)


def test_live_units_are_united() -> None:
    one = master()
    live(one, 1, 1, 2)
    live(one, 2, 2, 3)
    view = one.view(NOW_NS)
    assert shown(one) == {1: 1, 2: 2, 3: 1}
    assert view.complete
    assert view.units_live == 2
    assert view.oldest_view_age_s == pytest.approx(0.03)


def test_a_silent_unit_is_stale_and_makes_the_map_incomplete() -> None:
    one = master(stale_after_s=0.4)
    live(one, 1, 1, 2)
    second = live(one, 2, 2, 3)
    later_ns = NOW_NS + 380 * MS
    second.update(later_ns, [2, 3])
    assert one.view(NOW_NS + 369 * MS).complete
    assert shown(one, later_ns) == {2: 1, 3: 1}
    view = one.view(later_ns)
    assert not view.complete
    assert view.reasons == ("unit 1 (10.0.0.1) is stale: its last frame is 0.4 s old, at most 0.4 s are trusted",)
    one.change_settings({"stale_after_s": 0.5})
    assert shown(one, later_ns) == {1: 1, 2: 2, 3: 1}


def test_age_counts_from_the_capture_at_any_offset_of_the_clock() -> None:
    for offset_ns in (0, 10**15, -900 * S):
        one = master()
        unit = FakeUnit(one, offset_ns=offset_ns)
        unit.initialize()
        unit.update(NOW_NS, [1], age_ns=450 * MS, seen=sees_all(one))
        row = one.units(NOW_NS)[0]
        assert row.age_s == pytest.approx(0.45, abs=1e-4)
        assert row.arrival_age_s == 0.0
        assert row.state == "live"
        unit.update(NOW_NS, [1], age_ns=510 * MS)
        assert state(one, unit)[0] == "stale"
        assert shown(one) == {}


def test_a_delay_before_arrival_counts() -> None:
    one = master()
    unit = FakeUnit(one, delay_ns=200 * MS)
    unit.initialize()
    unit.update(NOW_NS, [1], age_ns=230 * MS)
    row = one.units(NOW_NS + 100 * MS)[0]
    assert row.age_s == pytest.approx(0.33, abs=1e-3)
    assert row.clock_uncertainty_ms == pytest.approx(200.0, abs=1.0)


@pytest.mark.parametrize("jump_ns", [3600 * S, -3600 * S])
def test_a_jump_of_a_units_clock_is_detected_and_recovered(jump_ns: int) -> None:
    one = master()
    unit = live(one, 1, 1)
    unit.offset_ns -= jump_ns
    unit.update(NOW_NS, [1])
    assert state(one, unit)[0] == "stale"
    assert shown(one) == {}
    unit.update(NOW_NS + MS, [1])
    assert state(one, unit) == ("live", "")


def test_without_an_exchange_a_units_age_is_not_known() -> None:
    one = master()
    unit = joined(one)
    unit.update(NOW_NS, [1], exchange=None)
    assert state(one, unit) == ("stale", "its clock is not known yet")


def test_a_clock_of_too_large_uncertainty_is_not_trusted() -> None:
    one = master()
    unit = joined(one)
    unit.update(NOW_NS, [1], exchange=Exchange(0, NOW_NS, NOW_NS, 4 * S))
    assert state(one, unit) == ("stale", "its clock is known to 2.0 s only")


def cause(one: Master, unit: FakeUnit, now_ns: int = NOW_NS) -> tuple[str, dict[str, float]]:
    row = next(row for row in one.units(now_ns) if row.id == unit.initialized.id)
    assert row.cause is not None
    assert row.cause.sentence == row.reason
    # As the viewer receives it.
    assert UnitRow.model_validate(row.model_dump(), strict=True) == row
    return row.cause.code, row.cause.numbers


LEARNS = Health(trouble="it learns", trouble_code="background", progress=Progress(task="background", done=3, total=60))


@pytest.mark.parametrize(
    ("changes", "code", "numbers"),
    [
        ({"exchange": None}, "clock_unknown", {}),
        ({"captured_at_ns": None}, "no_frame", {}),
        ({"age_ns": 700 * MS}, "late_frame", {"age_s": 0.7, "limit_s": 0.5}),
        ({"versions": Versions(settings=1, lattice=7, cell=1, pose=1)}, "old_lattice", {"version": 7, "current": 1}),
        ({"versions": Versions(settings=1, lattice=1, cell=7, pose=1)}, "old_cell", {"version": 7, "current": 1}),
        ({"versions": Versions(settings=1, lattice=1, cell=1, pose=7)}, "old_pose", {"version": 7, "current": 1}),
        ({"health": LEARNS}, "background", {"done": 3, "total": 60}),
        ({"health": Health(trouble="of an older unit")}, "trouble", {}),
        ({"health": GOOD.model_copy(update={"blind": "covered"})}, "covered", {}),
        ({"health": GOOD.model_copy(update={"moved": "by 30 mm"})}, "moved", {}),
        ({"health": GOOD.model_copy(update={"valid_share": 0.01})}, "few_pixels", {"valid_share": 0.01}),
        ({"health": GOOD.model_copy(update={"agreeing_share": 0.02})}, "few_surfaces", {"agreeing_share": 0.02}),
        ({"health": GOOD.model_copy(update={"warning": "USB 2"})}, "warning", {}),
        ({"health": Health(trouble="update me", trouble_code="contract"), "captured_at_ns": None}, "contract", {}),
    ],
)
def test_a_state_has_a_code_and_numbers(changes: dict[str, Any], code: str, numbers: dict[str, float]) -> None:
    one = master()
    unit = joined(one)
    unit.update(NOW_NS, [1], seen=sees_all(one), **changes)
    found, told = cause(one, unit)
    assert found == code
    assert told.items() >= numbers.items()
    (row,) = one.unit_states(NOW_NS)
    assert row.cause is not None
    assert row.cause.code == code
    causes = {each.code: each.numbers for each in one.view(NOW_NS).causes}
    assert (code in causes) == (row.state != "live")
    assert causes.get(code, {"unit": 1})["unit"] == 1


def test_a_silent_unit_is_silent_despite_earlier_trouble() -> None:
    one = master()
    unit = joined(one)
    assert cause(one, unit)[0] == "no_update"
    unit.update(NOW_NS, health=Health(trouble="update me", trouble_code="contract"))
    assert cause(one, unit) == ("contract", {})
    assert cause(one, unit, LATER_NS) == ("late_update", {"age_s": 60.0, "limit_s": 0.5})


def test_a_unit_without_a_frame_says_so() -> None:
    one = master()
    unit = joined(one)
    unit.update(NOW_NS, captured_at_ns=None, health=Health(trouble="camera: not there"))
    assert state(one, unit) == ("stale", "no frame yet (camera: not there)")


@pytest.mark.parametrize(
    ("health", "expected", "words"),
    [
        (GOOD.model_copy(update={"valid_share": 0.01}), "blind", "1%"),
        (GOOD.model_copy(update={"agreeing_share": 0.05}), "moved", "5%"),
        (GOOD.model_copy(update={"agreeing_share": 0.0, "static_share": 0.05}), "live", ""),
        (GOOD.model_copy(update={"trouble": "learning"}), "blind", "learning"),
    ],
)
def test_an_untrusted_view_gives_no_voxels(health: Health, expected: str, words: str) -> None:
    one = master()
    unit = live(one, 1, 1)
    unit.update(NOW_NS, [1], health=health)
    assert state(one, unit)[0] == expected
    assert words in state(one, unit)[1]
    assert shown(one) == ({1: 1} if expected == "live" else {})
    assert one.seen_by(NOW_NS).any() == (expected == "live")
    assert one.view(NOW_NS).complete == (expected == "live")


def test_frames_a_second_are_taken_from_captures() -> None:
    one = master()
    unit = joined(one)
    for step in range(2 * FPS_FRAMES):
        unit.update(NOW_NS + step * 40 * MS)
        # A frame that is sent twice counts once.
        unit.update(NOW_NS + step * 40 * MS + MS, age_ns=31 * MS)
    assert one.units(NOW_NS)[0].fps == pytest.approx(25.0, abs=0.1)


@pytest.mark.parametrize("keys", [b"\x01", b"\xff\xff\xff\xff", b"\2\0\0\0\1\0\0\0"])
def test_malformed_keys_change_nothing(keys: bytes) -> None:
    one = master()
    unit = live(one, 1, 5)
    with pytest.raises(WireError, match="keys"):
        one.update(unit.request(NOW_NS).model_copy(update={"keys": keys}), "10.0.0.1", NOW_NS)
    assert shown(one) == {5: 1}
    unit.update(NOW_NS, [6])
    assert shown(one) == {6: 1}


REPORTS = st.lists(
    st.tuples(
        st.integers(1, 3),
        st.sets(st.integers(0, 7999), max_size=8),
        st.integers(0, 400),
        st.booleans(),
    ),
    max_size=25,
)


@settings(deadline=None)
@given(REPORTS)
def test_the_map_is_the_union_of_the_newest_fresh_reports(history: list[tuple[int, set[int], int, bool]]) -> None:
    one = master(stale_after_s=0.5)
    units = {number: joined(one, number) for number in (1, 2, 3)}
    reports: dict[int, tuple[int, set[int]]] = {}
    now_ns = NOW_NS
    for number, keys, pause_ms, is_blind in history:
        now_ns += pause_ms * MS
        units[number].update(now_ns, keys, health=Health() if is_blind else GOOD)
        reports[number] = (now_ns, set() if is_blind else keys)
        expected: dict[int, int] = {}
        for captured_ns, reported in reports.values():
            if now_ns - captured_ns + 30 * MS <= 500 * MS:
                for key in reported:
                    expected[key] = expected.get(key, 0) + 1
        assert shown(one, now_ns) == expected


# ---------------------------------------------------------------------- complete


def test_an_empty_master_is_not_complete() -> None:
    view = master().view(NOW_NS)
    assert not view.complete
    assert view.reasons == ("there is no unit",)
    assert view.oldest_view_age_s is None


def test_a_unit_without_a_seen_report_makes_the_map_incomplete() -> None:
    one = master()
    unit = joined(one)
    unit.update(NOW_NS, [1])
    assert one.view(NOW_NS).reasons == ("unit 1 (10.0.0.1) has not reported what it looks through",)
    unit.update(NOW_NS, [1], seen=sees_all(one))
    assert one.view(NOW_NS).complete
    unit.update(NOW_NS, [1])
    assert one.view(NOW_NS).complete
    unit.initialize(NOW_NS, pose=None)
    unit.update(NOW_NS, [1])
    assert not one.view(NOW_NS).complete


def test_an_uncalibrated_unit_makes_the_map_incomplete() -> None:
    one = master()
    live(one)
    FakeUnit(one, ip="10.0.0.2", serial="B").initialize(pose=None)
    assert one.view(NOW_NS).reasons == ("unit 2 (10.0.0.2) is uncalibrated: its pose is not known yet",)


def test_a_silent_robot_makes_the_map_incomplete() -> None:
    one = master(with_robot=True)
    live(one)
    assert one.view(NOW_NS).reasons == ("the robot has not reported its joints yet",)
    one.put_joints(JointsRequest(positions=(0.0, 0.0)), NOW_NS)
    assert one.view(NOW_NS).complete
    one.change_settings({"robot_stale_after_s": 0.1})
    assert not one.view(NOW_NS + 101 * MS).complete


# ---------------------------------------------------------------------- changes at run time


def test_a_new_lattice_drops_all_voxels_and_refuses_old_ones() -> None:
    one = master()
    first, second = live(one, 1, 1), live(one, 2, 2)
    one.change_settings({"voxel_size_m": 0.1})
    assert shown(one) == {}
    assert not one.view(NOW_NS).complete
    stale = first.versions
    answer = first.update(NOW_NS + MS, [1999])
    assert (answer.versions.settings, answer.versions.lattice) == (2, 2)
    assert answer.settings is not None
    assert answer.settings.voxel_size_m == 0.1
    assert answer.lattice is not None
    assert answer.lattice.shape == (10, 20, 5)
    assert shown(one, NOW_NS + MS) == {}
    assert state(one, first, NOW_NS + MS) == ("stale", "it does not work on the current lattice yet")
    # Keys of the old lattice may exceed the new one, which is no error.
    second.update(NOW_NS + MS, [7999], versions=stale)
    first.update(NOW_NS + 2 * MS, [999], seen=sees_all(one))
    assert shown(one, NOW_NS + 2 * MS) == {999: 1}
    with pytest.raises(WireError, match="below 1000"):
        first.update(NOW_NS + 3 * MS, [1000])


def test_other_settings_do_not_change_the_map() -> None:
    one = master()
    unit = live(one, 1, 1)
    one.change_settings({"occupancy_threshold": 1.25})
    assert shown(one) == {1: 1}
    answer = unit.update(NOW_NS, [1])
    assert answer.settings is not None
    assert answer.settings.occupancy_threshold == 1.25
    assert unit.update(NOW_NS, [1]).settings is None


def test_settings_that_do_not_change_anything_have_no_new_version() -> None:
    one = master()
    before = one.versions
    one.change_settings({})
    one.change_settings({"voxel_size_m": 0.05})
    assert one.versions == before


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"voxel_size_m": 0.009}, "voxel_size_m: input should be greater than or equal to 0.01, got 0.009"),
        ({"voxel_size": 0.05}, "voxel_size: extra inputs are not permitted"),
        ({"density_rule": "none"}, "density_rule"),
        ({"stale_after_s": float("nan")}, "stale_after_s"),
        ({"occupancy_threshold": "much"}, "occupancy_threshold"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(changes: dict[str, Any], words: str) -> None:
    one = master()
    before = one.settings
    with pytest.raises(Refusal) as caught:
        one.change_settings(changes)
    assert caught.value.status == 422
    assert str(caught.value).startswith(words)
    assert one.settings == before
    assert one.versions == Versions(settings=1, lattice=1, cell=1)


def test_a_lattice_that_would_be_too_large_changes_nothing() -> None:
    one = Master(Cell("huge", np.zeros(3), np.array([20.0, 20.0, 10.0])), Settings())
    with pytest.raises(InputError, match="larger voxels"):
        one.change_settings({"voxel_size_m": 0.01})
    assert one.settings.voxel_size_m == 0.05


def test_settings_that_are_refused_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    one = master()
    unit = live(one, 1, 5)
    before = (one.settings, one.versions, one.lattice, one.coverage.blocks)

    def refuse(*_: Any) -> Lattice:
        raise InputError("no such blocks")

    monkeypatch.setattr(Cell, "blocks", refuse)
    with pytest.raises(InputError):
        one.change_settings({"voxel_size_m": 0.04, "seen_block_size_m": 0.05})
    assert (one.settings, one.versions, one.lattice, one.coverage.blocks) == before
    assert state(one, unit) == ("live", "")
    assert shown(one) == {5: 1}


def test_another_block_size_drops_the_seen_reports() -> None:
    one = master()
    unit = live(one)
    old = sees_all(one)
    one.change_settings({"seen_block_size_m": 0.25})
    assert not one.view(NOW_NS).complete
    unit.update(NOW_NS, seen=old)
    assert not one.view(NOW_NS).complete
    unit.update(NOW_NS, seen=sees_all(one))
    assert one.view(NOW_NS).complete


def test_a_new_pose_drops_reports_made_with_the_old_one() -> None:
    one = master()
    unit = live(one, 1, 1)
    moved = (*AT_ORIGIN[:2], (0.0, 0.0, 1.0, 0.3), AT_ORIGIN[3])
    one.set_pose(unit.initialized.id, moved, "operator", None)
    assert shown(one) == {}
    answer = unit.update(NOW_NS, [1])
    assert answer.T_world_camera == moved
    assert state(one, unit) == ("stale", "it does not work with its current pose yet")
    unit.update(NOW_NS, [2])
    assert shown(one) == {2: 1}
    assert not one.view(NOW_NS).complete


@pytest.mark.parametrize(("unit_id", "ip", "status"), [(9, None, 404), (1, "10.0.0.2", 403)])
def test_a_unit_sets_only_its_own_pose(unit_id: int, ip: str | None, status: int) -> None:
    one = master()
    live(one)
    with pytest.raises(Refusal) as caught:
        one.set_pose(unit_id, AT_ORIGIN, "configured", ip)
    assert caught.value.status == status


def test_commands_are_repeated_until_they_are_done() -> None:
    one = master()
    unit = live(one)
    command = one.send_command(unit.initialized.id, "learn_background", NOW_NS)
    assert unit.update(NOW_NS).commands == (command,)
    assert unit.update(NOW_NS).commands == (command,)
    (row,) = one.units(NOW_NS)
    assert row.last_command == CommandRow(id=command.id, verb="learn_background", outcome=None)
    assert unit.update(NOW_NS, done=(Ended.of(command.id, DONE),)).commands == ()
    assert unit.update(NOW_NS, done=(Ended.of(command.id, Outcome("failed", "too late")),)).commands == ()
    (row,) = one.units(NOW_NS)
    assert row.last_command == CommandRow(id=command.id, verb="learn_background", outcome="done", code="done")


def test_reads_change_and_log_nothing(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    one = master()
    unit = live(one, 1, 5)
    command = one.send_command(unit.initialized.id, "calibrate", NOW_NS)
    slot = one.registry.get(unit.initialized.id)
    one.tick(NOW_NS)
    before = (one.map.revision, slot.logged_state, slot.commands, slot.last_command, one.coverage.has(slot.id))
    caplog.clear()
    for now_ns, expected in ((NOW_NS, {5: 1}), (NOW_NS + 3600 * S, {}), (NOW_NS, {5: 1})):
        view = one.view(now_ns)
        assert dict(zip(view.keys.tolist(), view.witnesses.tolist(), strict=True)) == expected
        assert (view.complete, view.units_live, sorted(view.reports)) == (
            bool(expected),
            len(expected),
            [1][: len(expected)],
        )
        assert one.seen_by(now_ns).any() == bool(expected)
        (row,), (told,) = one.units(now_ns), one.unit_states(now_ns)
        assert row.state == told.state == ("live" if expected else "stale")
        assert row.voxels == told.voxels == 1
        assert row.last_command is not None
        assert (row.last_command.outcome is None) == bool(expected)
        one.next_change_ns(now_ns)
        one.robot_answer(None, now_ns)
    assert before == (one.map.revision, slot.logged_state, (command,), slot.last_command, one.coverage.has(slot.id))
    assert before[2] == (command,)
    assert not caplog.records
    one.tick(NOW_NS + 3600 * S)
    assert slot.logged_state == "stale"
    assert slot.commands == ()
    assert {record.levelname for record in caplog.records} == {"WARNING", "INFO"}


def test_commands_are_bounded() -> None:
    one = master()
    unit = live(one)
    for _ in range(MAX_COMMANDS):
        one.send_command(unit.initialized.id, "drop_background", NOW_NS)
    with pytest.raises(Refusal, match="wait for it already"):
        one.send_command(unit.initialized.id, "drop_background", NOW_NS)


def test_commands_that_are_never_answered_expire() -> None:
    one = master()
    unit = live(one)
    for _ in range(MAX_COMMANDS):
        one.send_command(unit.initialized.id, "calibrate", NOW_NS)
    later_ns = NOW_NS + round(COMMAND_EXPIRES_S * S)
    assert len(unit.update(later_ns - MS).commands) == MAX_COMMANDS
    (row,) = one.units(later_ns)
    assert row.last_command is not None
    assert row.last_command.outcome == "the unit did not answer within 600 s"
    assert unit.update(later_ns).commands == ()
    assert one.send_command(unit.initialized.id, "calibrate", later_ns).verb == "calibrate"


def test_a_unit_receives_only_new_joints() -> None:
    one = master(with_robot=True)
    unit = joined(one)
    for step in range(5):
        one.put_joints(JointsRequest(positions=(0.1 * step, 0.0)), NOW_NS + step * 10 * MS)
    answer = unit.update(NOW_NS + 50 * MS)
    assert [sample.positions[0] for sample in answer.joints] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert unit.update(NOW_NS + 51 * MS).joints == ()
    one.put_joints(JointsRequest(positions=(0.5, 0.0)), NOW_NS + 52 * MS)
    assert len(unit.update(NOW_NS + 53 * MS).joints) == 1


# ---------------------------------------------------------------------- which pose counts


def register(
    one: Master, pose: Matrix | None, ip: str = "10.0.0.1", serial: str = "S1", now_ns: int = LATER_NS
) -> FakeUnit:
    """Register a unit with the pose of its configuration."""
    unit = FakeUnit(one, ip=ip, serial=serial)
    request = unit.introduction(now_ns - MS).model_copy(update={"T_world_camera": pose})
    unit.initialized = one.initialize(request, ip, now_ns)
    unit.exchange = Exchange(now_ns - MS, now_ns, now_ns, now_ns + MS)
    unit.versions = unit.initialized.versions
    unit.update(now_ns + MS, [1])
    return unit


def shifted(x_m: float) -> Matrix:
    return ((1.0, 0.0, 0.0, x_m), *AT_ORIGIN[1:])


def test_a_configured_pose_that_changed_replaces_a_configured_one() -> None:
    one = master()
    first = register(one, shifted(0.1))
    assert first.initialized.T_world_camera == shifted(0.1)
    again = register(one, shifted(0.1), now_ns=LATER_NS + S)
    assert again.initialized.versions.pose == first.initialized.versions.pose
    moved = register(one, shifted(0.2), now_ns=LATER_NS + 2 * S)
    assert moved.initialized.T_world_camera == shifted(0.2)
    assert moved.initialized.versions.pose == first.initialized.versions.pose + 1
    row = one.units(LATER_NS + 2 * S)[0]
    assert (row.pose_origin, row.reason) == ("configured", "")
    # Without a configured pose it keeps the old one.
    assert register(one, None, now_ns=LATER_NS + 3 * S).initialized.T_world_camera == shifted(0.2)


@pytest.mark.parametrize("origin", ["operator", "board", "refined"])
def test_a_configured_pose_never_replaces_a_better_one_and_the_row_says_so(origin: PoseOrigin) -> None:
    one = master()
    register(one, shifted(0.1))
    one.set_pose(1, shifted(0.5), origin, None)
    unit = register(one, shifted(0.2))
    assert unit.initialized.T_world_camera == shifted(0.5)
    row = one.units(LATER_NS + MS)[0]
    assert (row.state, row.pose_origin) == ("live", origin)
    assert row.reason == (
        f"the unit's configuration has its camera 300 mm and 0.0° from where it is by the pose that counts ({origin})"
    )
    one.set_pose(1, shifted(0.2), "operator", None)
    assert one.registry.get(1).warning == ""


def test_a_refined_configured_pose_gives_no_warning() -> None:
    one = master()
    register(one, shifted(0.2))
    one.set_pose(1, shifted(0.25), "refined", None)
    assert register(one, shifted(0.2)).initialized.T_world_camera == shifted(0.25)
    assert one.units(LATER_NS + MS)[0].reason == ""


def test_two_cameras_behind_one_address_do_not_alternate() -> None:
    one = master()
    first = live(one, 1, 5)
    other = FakeUnit(one, ip="10.0.0.1", serial="B")
    with pytest.raises(Refusal, match=r"camera S1 reports from IP 10\.0\.0\.1 .*an IP of its own") as caught:
        other.initialize(NOW_NS + 100 * MS)
    assert caught.value.status == 409
    first.update(NOW_NS + 200 * MS, [6])
    assert shown(one, NOW_NS + 200 * MS) == {6: 1}
    assert one.units(NOW_NS)[0].serial == "S1"


def test_a_row_has_the_camera_model_and_its_range() -> None:
    one = master()
    unit = joined(one, 1)
    (row,) = one.units(NOW_NS)
    assert (row.intrinsics, row.range_m) == (Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0), None)
    unit.update(NOW_NS, [5], seen=sees_all(one))
    # The highest block of a cell of half a metre, from its floor.
    assert one.units(NOW_NS)[0].range_m == 0.45


@pytest.mark.parametrize("verb", ["learn_background", "refine", "calibrate", "image"])
def test_a_unit_that_does_not_understand_its_master_is_sent_no_command(verb: Verb) -> None:
    one = master()
    unit = joined(one)
    unit.update(NOW_NS, health=Health(trouble="update this unit: it speaks contract 5.0", trouble_code="contract"))
    with pytest.raises(Refusal, match="takes no commands of this master: update this unit") as refused:
        one.registry.send_command(one.registry.get(unit.initialized.id), verb, NOW_NS)
    assert refused.value.status == 409
    unit.update(NOW_NS)
    assert one.registry.send_command(one.registry.get(unit.initialized.id), verb, NOW_NS).verb == verb
