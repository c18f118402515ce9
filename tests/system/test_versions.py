# SPDX-License-Identifier: Apache-2.0
"""Masters, units and what they keep, of different versions: understood, or refused in words."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from master_server.core import Master
from master_server.persistence import Store
from master_server.recording.moment import StateRecord
from shared.cell import Cell
from shared.messages import DONE, Ended, InitializeAnswer, Outcome, PoseAnswer, RobotAnswer
from shared.settings import Settings
from shared.wire import decode, decode_update, decode_update_answer
from tests.system.conversation import GOLDEN, Step, Table, plain, recorded, recorded_cell

ANSWERS = {"/initialize": InitializeAnswer, "/robot": RobotAnswer, "/units/1/pose": PoseAnswer}
"""What a unit reads, by path; beside the answers to updates, and the cell."""


def keeps(now: Any, before: Any) -> bool:
    """Whether all that stood in `before` stands in `now`; names may have been added."""
    if isinstance(before, dict):
        return isinstance(now, dict) and all(name in now and keeps(now[name], before[name]) for name in before)
    if isinstance(before, list):
        return isinstance(now, list) and len(now) == len(before) and all(map(keeps, now, before))
    return bool(now == before)


def test_only_what_stays_is_kept() -> None:
    assert keeps({"a": [1, {"b": 2, "c": 3}], "d": 4}, {"a": [1, {"b": 2}]})
    for now in ({}, {"a": [1]}, {"a": [1, {}]}, {"a": [1, {"b": 3}]}, {"a": [1, {"b": 2}, 5]}, [], 1):
        assert not keeps(now, {"a": [1, {"b": 2}]})


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> Table:
    return Table("5.0", monkeypatch)


async def test_a_unit_of_5_0_is_answered_byte_by_byte_as_it_was(table: Table) -> None:
    steps = recorded("5.0")
    for now, before in zip(await table.replay(steps), steps, strict=True):
        assert now.status == before.status, before.name
        if before.is_units and before.status < 400:
            assert now.answer == before.answer, before.name


async def test_readers_of_5_0_find_what_they_found(table: Table) -> None:
    steps = recorded("5.0")
    for now, before in zip(await table.replay(steps), steps, strict=True):
        if not before.is_units:
            assert keeps(plain(now), plain(before)), before.name


async def test_what_a_unit_of_5_0_says_of_its_commands_has_a_code(table: Table) -> None:
    told = {}
    for step in await table.replay(recorded("5.0")):
        if step.path == "/units" and (command := plain(step)[0]["last_command"]):
            told[command["verb"]] = command["outcome"], command["code"], command["detail"]
    why = "the pose of its camera is not known yet"
    assert told == {"calibrate": ("done", "done", ""), "drop_background": (why, "failed", why)}


@pytest.mark.parametrize(
    ("text", "outcome"),
    [
        ("done", DONE),
        ("done: moved by 3 mm: much", Outcome("done", "moved by 3 mm: much")),
        ("donee: no", Outcome("failed", "donee: no")),
        ("the board is not in view", Outcome("failed", "the board is not in view")),
        ("", Outcome("failed", "")),
    ],
)
def test_an_outcome_of_a_unit_of_5_0(text: str, outcome: Outcome) -> None:
    assert Ended(1, text).outcome == outcome
    assert Ended.of(1, outcome).outcome == outcome


def answers() -> list[Step]:
    return [step for step in recorded("5.0") if step.is_units and step.status < 400]


@pytest.mark.parametrize("step", answers(), ids=lambda step: step.name)
def test_what_a_master_of_5_0_answered_is_read(step: Step) -> None:
    path = step.path.split("?")[0]
    if path == "/update":
        assert list(decode_update_answer(step.answer).versions.model_dump().values()) == plain(step)["versions"]
        assert decode_update(step.body).id == 1
    elif path == "/cell":
        assert Cell.from_document(plain(step), recorded_cell("5.0")[1]).name == "golden"
    else:
        assert keeps(decode(ANSWERS[path], step.answer).model_dump(mode="json"), plain(step))


def test_no_setting_of_5_0_has_another_name_or_default() -> None:
    registered = next(step for step in answers() if step.path == "/initialize")
    assert keeps(Settings().model_dump(mode="json"), plain(registered)["settings"])


def test_what_a_recording_of_5_0_holds_is_read() -> None:
    kept = json.loads((GOLDEN / "5.0" / "states.json").read_text())
    assert len(kept) == 2
    for state in kept:
        assert keeps(StateRecord.model_validate(state).model_dump(mode="json"), state)


def test_a_master_of_now_goes_on_with_what_one_of_5_0_kept(tmp_path: Path) -> None:
    path = tmp_path / "master.db"
    with sqlite3.connect(path) as kept:
        kept.executescript((GOLDEN / "5.0" / "master.sql").read_text())
    kept.close()
    store = Store.open(path)
    document, meshes = recorded_cell("5.0")
    one = Master(Cell.from_document(document, meshes), Settings(), store)
    store.close()
    (unit,) = one.registry
    assert (unit.serial, unit.record.pose_origin) == ("233522071234", "board")
    assert (one.settings.voxel_size_m, one.versions.cell) == (0.04, 2)
    assert one.cell.objects[0].T_world_mesh[0, 3] == 0.3
