# SPDX-License-Identifier: Apache-2.0
"""The stored state: files that are whole, foreign, damaged or full, and restarts of the master."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master_server.core import Master
from master_server.persistence import Store, UnitRecord
from master_server.persistence import store as store_module
from master_server.persistence.store import FILE_NAME, SCHEMA_VERSION
from shared.camera import Intrinsics
from shared.cell import Cell, PlacedMesh
from shared.errors import ConfigError, Refusal
from shared.meshes import box_mesh
from shared.messages import Matrix, PoseQuality
from shared.settings import Settings
from shared.waiting import within
from tests.master_server.fakes import AT_ORIGIN, MS, START_NS, FakeUnit, S, cell, joined, sees_all

NOW_NS = START_NS
LATER_NS = START_NS + 10 * S
ELSEWHERE: Matrix = ((1.0, 0.0, 0.0, 0.1), *AT_ORIGIN[1:])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / FILE_NAME


@pytest.fixture
def store(path: Path) -> Iterator[Store]:
    store = Store.open(path)
    yield store
    store.close()


def with_box(size_m: float = 0.2) -> Cell:
    body = PlacedMesh("box", box_mesh("box", (size_m, size_m, size_m)), np.eye(4))
    return Cell("boxed", np.zeros(3), np.array([1.0, 2.0, 0.5]), objects=(body,))


def fill(store: Store) -> None:
    """Fill the disk for this store."""
    pages = store._connection.execute("PRAGMA page_count").fetchone()[0]
    store._connection.execute(f"PRAGMA max_page_count = {pages}")
    free = store._connection.execute("PRAGMA freelist_count").fetchone()[0]
    assert free == 0


def make_writes_fail(store: Store) -> None:
    store._connection.execute("PRAGMA query_only = ON")


def make_writes_work(store: Store) -> None:
    store._connection.execute("PRAGMA query_only = OFF")


# ---------------------------------------------------------------------- restarts


def test_acknowledged_changes_survive_a_restart(path: Path) -> None:
    store = Store.open(path)
    one = Master(with_box(), Settings(), store)
    joined(one, 1)
    second = joined(one, 2)
    one.set_pose(second.initialized.id, ELSEWHERE, "board", None, PoseQuality(uncertainty_mm=1.5))
    one.change_settings({"voxel_size_m": 0.1})
    one.forget(joined(one, 3).initialized.id)
    before = (one.versions, one.settings, [slot.record for slot in one.registry])
    store.close()

    store = Store.open(path)
    two = Master(with_box(), Settings(), store)
    assert (two.versions, two.settings, [slot.record for slot in two.registry]) == before
    assert two.cell.version == one.cell.version
    rows = two.units(NOW_NS)
    assert [(row.id, row.state, row.reason) for row in rows] == [
        (1, "stale", "no update since the master started"),
        (2, "stale", "no update since the master started"),
    ]
    assert [(row.T_world_camera, row.pose_origin) for row in rows] == [
        (AT_ORIGIN, "configured"),
        (ELSEWHERE, "board"),
    ]
    assert [row.pose_quality.uncertainty_mm for row in rows] == [None, 1.5]
    assert [row.intrinsics for row in rows] == [Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)] * 2
    # Earlier seen reports do not count now.
    assert [row.range_m for row in rows] == [None, None]
    assert not two.view(NOW_NS).complete
    # An id is never given twice.
    assert joined(two, 4).initialized.id == 4
    two.forget(4)
    store.close()


def test_a_map_is_complete_again_once_every_unit_has_reported_or_is_deleted() -> None:
    store = Store.in_memory()
    one = Master(cell(), Settings(), store)
    joined(one, 1), joined(one, 2)
    two = Master(cell(), Settings(), store)
    unit = FakeUnit(two, ip="10.0.0.1", serial="S1")
    assert unit.initialize(NOW_NS, pose=None).T_world_camera == AT_ORIGIN
    unit.update(NOW_NS + MS, [1], seen=sees_all(two))
    assert two.view(NOW_NS + MS).reasons == ("unit 2 (10.0.0.2) is stale: no update since the master started",)
    two.forget(2)
    assert two.view(NOW_NS + MS).complete


def test_a_session_of_an_earlier_master_is_expired() -> None:
    store = Store.in_memory()
    unit = joined(Master(cell(), Settings(), store))
    unit.update(NOW_NS, [1])
    unit.master = Master(cell(), Settings(), store)
    with pytest.raises(Refusal, match="session") as caught:
        unit.update(NOW_NS + MS, [1])
    assert caught.value.status == 409


def test_updates_and_units_that_register_again_write_nothing(store: Store) -> None:
    one = Master(cell(), Settings(), store)
    unit = joined(one)
    before = store._connection.total_changes
    unit.update(NOW_NS, [1, 2], seen=sees_all(one))
    unit.initialize(NOW_NS + MS)
    unit.update(NOW_NS + 2 * MS, [1, 2])
    assert store._connection.total_changes == before
    one.set_pose(1, ELSEWHERE, "operator", None)
    assert store._connection.total_changes > before


# ---------------------------------------------------------------------- configured against stored values


def restart(store: Store, watched: Cell, caplog: pytest.LogCaptureFixture, **settings: Any) -> Master:
    caplog.clear()
    caplog.set_level(logging.INFO)
    return Master(watched, Settings(**settings), store)


def test_a_cell_changed_by_the_api_outlives_the_master_until_its_file_changes(
    store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    one = Master(with_box(), Settings(), store)
    one.move_object("box", ELSEWHERE)
    moved = one.cell.version
    two = restart(store, with_box(), caplog)
    assert (two.cell.version, two.versions.cell) == (moved, one.versions.cell)
    assert "the stored one counts" in caplog.text
    three = restart(store, with_box(0.3), caplog)
    assert three.cell.version == with_box(0.3).version
    assert three.versions.cell == two.versions.cell + 1
    assert "its file changed and counts" in caplog.text
    # Meshes that no cell names are deleted.
    assert set(dict(store._connection.execute("SELECT sha256, 1 FROM meshes"))) == set(with_box(0.3).to_document()[1])
    four = restart(store, with_box(0.3), caplog)
    assert (four.cell.version, four.versions) == (three.cell.version, three.versions)
    assert caplog.text == ""


def test_settings_of_the_configuration_count_where_they_changed(store: Store, caplog: pytest.LogCaptureFixture) -> None:
    one = Master(cell(), Settings(voxel_size_m=0.1), store)
    one.change_settings({"voxel_size_m": 0.05, "occupancy_threshold": 0.7})
    two = restart(store, cell(), caplog, voxel_size_m=0.1)
    assert (two.settings.voxel_size_m, two.settings.occupancy_threshold) == (0.05, 0.7)
    assert two.versions == one.versions
    assert "the stored voxel_size_m count" in caplog.text
    three = restart(store, cell(), caplog, voxel_size_m=0.08)
    assert (three.settings.voxel_size_m, three.settings.occupancy_threshold) == (0.08, 0.7)
    assert three.versions.settings == two.versions.settings + 1
    assert three.versions.lattice == two.versions.lattice + 1
    assert "voxel_size_m changed in the configuration" in caplog.text


def test_stored_settings_that_do_not_fit_are_reported_and_left_out(
    store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    Master(cell(), Settings(), store).change_settings({"occupancy_threshold": 0.7})
    store._connection.execute(
        "UPDATE facts SET value = json_set(value, '$.of_tomorrow', 1, '$.voxel_size_m', 9) WHERE name = 'settings'"
    )
    one = restart(store, cell(), caplog)
    assert (one.settings.voxel_size_m, one.settings.occupancy_threshold) == (Settings().voxel_size_m, 0.7)
    assert "the stored of_tomorrow, voxel_size_m no longer fit" in caplog.text


def test_stored_empty_ranges_are_left_out(store: Store, caplog: pytest.LogCaptureFixture) -> None:
    Master(cell(), Settings(), store).change_settings({"occupancy_threshold": 0.7})
    store._connection.execute(
        "UPDATE facts SET value = json_set(value, '$.range_min_m', 5, '$.range_max_m', 0.5) WHERE name = 'settings'"
    )
    settings = restart(store, cell(), caplog).settings
    assert (settings.range_min_m, settings.range_max_m, settings.occupancy_threshold) == (5.0, 10.0, 0.7)
    assert "the stored range_max_m no longer fit" in caplog.text


def test_an_empty_range_is_refused(store: Store) -> None:
    master = Master(cell(), Settings(), store)
    master.change_settings({"range_max_m": 2.0})
    for changes in ({"range_min_m": 2.0}, {"range_min_m": 5.0, "range_max_m": 0.5}):
        with pytest.raises(Refusal, match="range_max_m: value error, expected more than range_min_m") as refused:
            master.change_settings(changes)
        assert refused.value.status == 422
    assert (master.settings.range_min_m, master.settings.range_max_m) == (0.0, 2.0)


# ---------------------------------------------------------------------- files


def test_a_foreign_file_is_refused_and_unchanged(path: Path) -> None:
    path.parent.mkdir()
    for content in (b"", b"hello, this is text", b"x" * 100_000):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=r"master\.db: .*start anew"):
            Store.open(path)
        assert path.read_bytes() == content
    path.unlink()
    foreign = sqlite3.connect(path)
    foreign.execute("CREATE TABLE songs (name TEXT)")
    foreign.close()
    with pytest.raises(ConfigError, match="no store of a master"):
        Store.open(path)


def test_a_store_of_a_newer_master_is_refused(path: Path) -> None:
    Store.open(path).close()
    newer = sqlite3.connect(path)
    newer.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    newer.close()
    content = path.read_bytes()
    with pytest.raises(ConfigError, match=f"got version {SCHEMA_VERSION + 1}.*newer.*put back"):
        Store.open(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize("version", [0, -3])
def test_a_store_of_a_version_that_never_was_is_refused(path: Path, version: int) -> None:
    Store.open(path).close()
    other = sqlite3.connect(path)
    other.execute(f"PRAGMA user_version = {version}")
    other.close()
    with pytest.raises(ConfigError, match=f"a store of version {version}, which never was"):
        Store.open(path)


def test_a_store_of_an_older_master_is_migrated(path: Path) -> None:
    store = Store.open(path)
    one = Master(with_box(), Settings(), store)
    one.set_pose(joined(one, 1).initialized.id, ELSEWHERE, "board", None)
    units = store.load().units
    store.close()
    older = sqlite3.connect(path)
    older.executescript(
        "ALTER TABLE units DROP COLUMN pose_quality; ALTER TABLE units DROP COLUMN intrinsics; PRAGMA user_version = 1"
    )
    older.close()
    for _ in range(2):
        with contextlib.closing(Store.open(path)) as opened:
            assert opened.load().units == tuple(unit.model_copy(update={"intrinsics": None}) for unit in units)
            assert opened._connection.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)


def test_a_damaged_file_is_refused_and_never_replaced(path: Path) -> None:
    store = Store.open(path)
    Master(with_box(), Settings(), store)
    store.close()
    whole = path.read_bytes()
    refused = 0
    for seed in range(40):
        dice = random.Random(seed)
        content = bytearray(whole)
        at = dice.randrange(0, len(content) - 600)
        content[at : at + 600] = dice.randbytes(600)
        path.write_bytes(content)
        try:
            with contextlib.closing(Store.open(path)) as opened:
                saved = opened.load()
        except ConfigError:
            refused += 1
            assert path.stat().st_size == len(whole)
        else:
            # The damage hit unused bytes.
            assert saved.cell is not None
            assert saved.cell.version == with_box().version
    assert refused > 5


def test_a_log_without_its_file_is_not_taken_for_a_new_store(path: Path) -> None:
    path.parent.mkdir()
    path.with_name(FILE_NAME + "-wal").write_bytes(b"x")
    with pytest.raises(ConfigError, match=r"master\.db-wal"):
        Store.open(path)
    assert not path.exists()


def test_two_masters_do_not_share_a_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("master_server.persistence.store.LOCK_TIMEOUT_S", 0.1)
    store = Store.open(path)
    with pytest.raises(ConfigError, match="another master"):
        Store.open(path)
    store.close()
    Store.open(path).close()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="file/state"):
        Store.open(tmp_path / "file" / "state" / FILE_NAME)


# ---------------------------------------------------------------------- a power cut in mid-write


def test_a_log_cut_anywhere_gives_the_state_after_one_of_the_changes(path: Path, tmp_path: Path) -> None:
    store = Store.open(path)
    states = [store.load().units]
    for number in range(30):
        gone = [number - 3] if number % 5 == 4 else []
        store.save_units([UnitRecord(id=number % 7 + 1, ip=f"10.0.0.{number % 7}", note="x" * 700 * number)], gone)
        states.append(store.load().units)
    log = path.with_name(FILE_NAME + "-wal")
    whole = log.read_bytes()
    found = set()
    for seed in range(100):
        dice = random.Random(seed)
        folder = tmp_path / f"cut{seed}"
        folder.mkdir()
        shutil.copy(path, folder / FILE_NAME)
        cut = dice.randrange(len(whole) + 1)
        # Bytes that the disk had not written yet are missing, or have their old values.
        (folder / log.name).write_bytes(whole[:cut] + (dice.randbytes(5000) if seed % 2 else b""))
        opened = Store.open(folder / FILE_NAME)
        found.add(states.index(opened.load().units))
        opened.close()
    store.close()
    assert len(found) > 10


def test_a_file_cut_anywhere_is_whole_or_refused(path: Path, tmp_path: Path) -> None:
    store = Store.open(path)
    Master(with_box(), Settings(), store)
    store.save_units([UnitRecord(id=number, ip=f"10.0.0.{number}", note="x" * 900) for number in range(1, 40)])
    expected = store.load().units
    store.close()
    whole = path.read_bytes()
    for seed in range(60):
        cut = random.Random(seed).randrange(len(whole))
        path.write_bytes(whole[:cut])
        try:
            opened = Store.open(path)
        except ConfigError:
            continue
        assert opened.load().units == expected
        opened.close()


# ---------------------------------------------------------------------- a full disk


def test_a_change_that_cannot_be_stored_is_not_applied(store: Store) -> None:
    one = Master(with_box(), Settings(), store)
    unit = joined(one, 1)
    unit.update(NOW_NS, [5], seen=sees_all(one))
    before = (one.versions, one.settings, one.cell.version, [slot.record for slot in one.registry], store.load())
    make_writes_fail(store)
    other = FakeUnit(one, ip="10.0.0.2", serial="S2")
    for change in (
        lambda: one.set_pose(1, ELSEWHERE, "operator", None),
        lambda: one.change_settings({"voxel_size_m": 0.1}),
        lambda: one.move_object("box", ELSEWHERE),
        lambda: one.forget(1),
        lambda: other.initialize(NOW_NS),
    ):
        with pytest.raises(Refusal, match="nothing was changed") as caught:
            change()
        assert caught.value.status == 507
        after = (one.versions, one.settings, one.cell.version, [slot.record for slot in one.registry], store.load())
        assert repr(after[:4]) == repr(before[:4])
        assert after[4].units == before[4].units
        assert store.trouble is not None
    # Updates and reads go on.
    unit.update(NOW_NS + MS, [6])
    assert one.view(NOW_NS + MS).keys.tolist() == [6]
    make_writes_work(store)
    assert other.initialize(NOW_NS).id == 2
    assert store.trouble is None


async def test_recovery_of_the_disk_is_detected_without_a_change(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module, "TRY_EVERY_S", 0.05)
    one = await asyncio.to_thread(Master, with_box(), Settings(), store)
    await asyncio.to_thread(make_writes_fail, store)
    with pytest.raises(Refusal, match="nothing was changed"):
        one.change_settings({"voxel_size_m": 0.1})
    with pytest.raises(Refusal):
        await asyncio.to_thread(store.attempt)
    before = await asyncio.to_thread(store.load)

    async def until_recovered() -> None:
        while store.trouble is not None:
            await asyncio.sleep(0.01)

    task = asyncio.create_task(store.follow())
    assert not await within(0.3, until_recovered())
    await asyncio.to_thread(make_writes_work, store)
    assert await within(5.0, until_recovered())
    task.cancel()
    after = await asyncio.to_thread(store.load)
    assert (after.versions, after.settings, after.units) == (before.versions, before.settings, before.units)


def test_a_full_disk_is_reported(store: Store) -> None:
    one = Master(cell(), Settings(), store)
    fill(store)

    def come() -> None:
        for number in range(1, 40):
            FakeUnit(one, ip=f"10.0.0.{number}", serial=f"S{number}", boot_id="x" * 200).initialize(NOW_NS)

    with pytest.raises(Refusal, match="full"):
        come()
    assert [slot.record for slot in one.registry] == list(store.load().units)


def test_a_known_unit_comes_back_though_its_new_boot_cannot_be_stored(store: Store) -> None:
    one = Master(cell(), Settings(), store)
    joined(one, 1)
    make_writes_fail(store)
    again = FakeUnit(one, ip="10.0.0.1", serial="S1", boot_id="another boot")
    again.initialize(LATER_NS)
    again.update(LATER_NS, [5])
    assert one.view(LATER_NS).keys.tolist() == [5]
    assert [slot.record for slot in one.registry] == list(store.load().units)


def test_meshes_ahead_of_their_cell_are_kept_for_it(store: Store) -> None:
    one = Master(cell(), Settings(), store)
    document, meshes = with_box().to_document()
    # Those of a cell that was refused afterwards are deleted.
    store.add_meshes(with_box(0.4).to_document()[1])
    store.add_meshes(meshes)
    assert set(dict(store._connection.execute("SELECT sha256, 1 FROM meshes"))) == set(meshes)
    store.save_cell(document, meshes, one.versions)
    saved = store.load().cell
    assert saved is not None
    assert saved.version == with_box().version
