# SPDX-License-Identifier: Apache-2.0
"""Masters, units and what they keep, of different versions: understood, or refused in words."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sqlite3
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest

from edge_unit.sources.frame import CameraInfo
from edge_unit.uplink.cell_cache import CellCache
from edge_unit.uplink.client import MasterClient
from edge_unit.uplink.master_selection import MasterCriteria, objection
from edge_unit.uplink.uplink import NOT_OURS, Uplink
from master_server.app import make_app
from master_server.core import Master
from master_server.persistence import Store
from master_server.recording.moment import StateRecord
from master_server.security import Access
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.clock import monotonic_ns
from shared.discovery import Announcement, offer_of
from shared.errors import CellError, MasterRefused, WireError
from shared.messages import (
    CONTRACT_MINOR,
    CONTRACT_VERSION,
    DONE,
    Ended,
    InitializeAnswer,
    InitializeRequest,
    Outcome,
    PoseAnswer,
    RobotAnswer,
    Versions,
)
from shared.settings import Settings
from shared.wire import decode, decode_update, decode_update_answer, encode, unpack
from tests.system.conversation import (
    GOLDEN,
    OPERATOR,
    UNIT,
    Step,
    Table,
    plain,
    recorded,
    recorded_cell,
    versions,
)

ANSWERS = {"/initialize": InitializeAnswer, "/robot": RobotAnswer, "/units/1/pose": PoseAnswer}
"""Answers that a unit reads, by path; besides them it reads the answers to updates, and the cell."""


SENTENCES = ("reason", "reasons", "sentence", "detail", "outcome")
"""Names of what is said to people; programs of 5.1 and later read the codes beside them."""

VERSIONS = versions()


def keeps(now: Any, before: Any) -> bool:
    """Return True if `now` has all that `before` has; names may have been added, and sentences may be other ones."""
    if isinstance(before, dict):
        return isinstance(now, dict) and all(
            name in now and (name in SENTENCES or keeps(now[name], before[name])) for name in before
        )
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


@pytest.mark.parametrize("version", VERSIONS)
async def test_a_unit_of_any_minor_is_answered_byte_by_byte_as_it_was(
    monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    steps = recorded(version)
    for now, before in zip(await Table(version, monkeypatch).replay(steps), steps, strict=True):
        assert now.status == before.status, before.name
        if before.is_units and before.status < 400:
            assert now.answer == before.answer, before.name


@pytest.mark.parametrize("version", VERSIONS)
async def test_readers_of_any_minor_find_what_they_found(monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    steps = recorded(version)
    for now, before in zip(await Table(version, monkeypatch).replay(steps), steps, strict=True):
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


def answers(version: str) -> list[Step]:
    return [step for step in recorded(version) if step.is_units and step.status < 400]


ANSWERED = [
    pytest.param(version, step, id=f"{version} {step.name}") for version in VERSIONS for step in answers(version)
]


@pytest.mark.parametrize(("version", "step"), ANSWERED)
def test_the_answers_of_a_master_of_any_minor_are_read(version: str, step: Step) -> None:
    path = step.path.split("?")[0]
    if path == "/update":
        assert list(decode_update_answer(step.answer).versions.model_dump().values()) == plain(step)["versions"]
        assert decode_update(step.body).id == 1
    elif path == "/cell":
        assert Cell.from_document(plain(step), recorded_cell(version)[1]).name == "golden"
    else:
        assert keeps(decode(ANSWERS[path], step.answer).model_dump(mode="json"), plain(step))


@pytest.mark.parametrize("more", [{}, {"lidar": {"lines": 16}}])
async def test_a_unit_of_a_newer_minor_is_told_to_wait_for_its_master(table: Table, more: dict[str, Any]) -> None:
    asked = unpack(recorded("5.0")[0].body, 2**20) | {"contract_minor": CONTRACT_MINOR + 1} | more
    told = await table.say("", "POST", "/initialize", UNIT, msgpack.packb(asked))
    assert told.status == 400
    for word in (f"5.{CONTRACT_MINOR}", f"5.{CONTRACT_MINOR + 1}", "update the master first"):
        assert word in plain(told)["detail"]
    assert len(table.master.registry) == 0
    # Of our own minor, a name that nobody knows is one that was misspelt.
    own = await table.say("", "POST", "/initialize", UNIT, msgpack.packb(asked | {"contract_minor": CONTRACT_MINOR}))
    assert own.status == (422 if more else 200)


async def test_a_unit_of_an_older_major_is_to_be_updated(table: Table) -> None:
    asked = unpack(recorded("5.0")[0].body, 2**20) | {"contract": 4}
    told = await table.say("", "POST", "/initialize", UNIT, msgpack.packb(asked))
    assert told.status == 400
    assert "update the unit first" in plain(told)["detail"]


def client_of(*answers: Step) -> MasterClient:
    """A client of a master that gives these answers, one after the other."""
    pending = iter(answers)

    def answer(_: httpx.Request) -> httpx.Response:
        step = next(pending)
        return httpx.Response(step.status, content=step.answer)

    return MasterClient("http://master", lambda: UNIT, transport=httpx.MockTransport(answer))


def request_of_now() -> InitializeRequest:
    return InitializeRequest(
        contract=CONTRACT_VERSION,
        contract_minor=CONTRACT_MINOR,
        serial="A",
        intrinsics=Intrinsics(8, 6, 10.0, 10.0, 4.0, 3.0),
        sent_at_ns=1,
    )


@pytest.mark.parametrize("name", ["a newer minor is refused", "registers without a pose"])
async def test_a_unit_says_that_its_master_is_too_old(name: str) -> None:
    step = next(step for step in recorded("5.0") if step.name == name)
    async with client_of(step) as client:
        with pytest.raises(MasterRefused, match=r"speaks version 5\.0.*update the master first") as refused:
            await client.initialize(request_of_now())
    assert refused.value.status in NOT_OURS


async def test_what_else_a_master_refuses_is_told_as_it_says() -> None:
    step = replace(recorded("5.0")[0], answer=b'{"detail":"serial: field required"}')
    async with client_of(step) as client:
        with pytest.raises(MasterRefused, match="422: serial: field required"):
            await client.initialize(request_of_now())


async def test_a_unit_ignores_what_it_need_not_know_of_a_newer_master(table: Table) -> None:
    asked = encode(request_of_now())
    told = plain(await table.say("", "POST", "/initialize", UNIT, asked))
    assert told["contract_minor"] == CONTRACT_MINOR
    newer = told | {"contract_minor": CONTRACT_MINOR + 1, "mood": "good"}
    newer["versions"] = told["versions"] | {"attachments": 3}
    async with client_of(Step("", "", "", UNIT, b"", 200, msgpack.packb(newer))) as client:
        assert (await client.initialize(request_of_now())).session == told["session"]
    update = {"versions": [1, 1, 1, 0, 3], "received_at_ns": 5, "answered_at_ns": 6, "mood": "good"}
    assert decode_update_answer(msgpack.packb(update)).versions == Versions(settings=1, lattice=1, cell=1)


async def test_progress_and_outcomes_of_5_1_are_codes_and_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {step.name: plain(step) for step in await Table("5.1", monkeypatch).replay(recorded("5.1"))}
    learning = told["readers ask for the units that learn"][0]
    assert (learning["cause"]["code"], learning["cause"]["numbers"]) == ("background", {"done": 3.0, "total": 60.0})
    assert learning["health"]["progress"] == {"task": "background", "done": 3, "total": 60}
    assert told["readers ask for the units"][0]["health"]["progress"]["task"] == "refinement"
    assert told["readers ask for a map that is not complete"]["causes"][0]["code"] == "background"
    assert told["readers ask what came of the fourth"][0]["last_command"]["code"] == "failed"


async def test_a_unit_of_5_0_has_reasons_without_numbers(table: Table) -> None:
    told = {step.name: plain(step) for step in await table.replay(recorded("5.0")) if not step.is_units}
    learning = told["readers ask for the units that learn"][0]
    assert learning["cause"] == {"code": "trouble", "sentence": learning["reason"], "numbers": {}}
    assert (learning["health"]["progress"], learning["contract_minor"]) == (None, 0)
    incomplete = told["readers ask for a map that is not complete"]
    assert [cause["code"] for cause in incomplete["causes"]] == ["trouble"]
    assert incomplete["causes"][0]["numbers"] == {"unit": 1.0}
    assert [cause["sentence"] for cause in incomplete["causes"]] == incomplete["reasons"]


def worse(step: Step, *path: str) -> bytes:
    """An answer with a name more in one of its parts."""
    fields = part = plain(step)
    for name in path:
        part = part[name]
    part["newer"] = 1
    return bytes(msgpack.packb(fields))


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("gets settings", ["settings"]),
        ("gets settings", ["lattice"]),
        ("learns of another cell", ["cell"]),
        ("registers without a pose", ["settings"]),
        ("registers without a pose", ["cell"]),
        ("asks for joints", []),
        ("tells its pose", []),
    ],
)
def test_a_unit_refuses_what_it_would_have_to_obey(name: str, path: list[str]) -> None:
    step = next(step for step in recorded("5.0") if step.name == name)
    asked = step.path.split("?")[0]
    read = decode_update_answer if asked == "/update" else partial(decode, ANSWERS[asked])
    with pytest.raises(WireError, match="newer"):
        read(worse(step, *path))


def test_a_unit_refuses_a_cell_of_which_it_does_not_know_all() -> None:
    document, meshes = recorded_cell("5.0")
    for part in (document, document["objects"][0], document["robot"], document["board"]):
        part["newer"] = 1
        with pytest.raises(CellError, match="newer"):
            Cell.from_document(document, meshes)
        del part["newer"]
    assert Cell.from_document(document, meshes).name == "golden"


class NewerMaster(httpx.AsyncBaseTransport):
    """A master of the next minor: that of now, whose answers at `paths` have a name more in one of their parts."""

    def __init__(self, master: Master, *paths: tuple[str, str]) -> None:
        app = make_app(master, Access(UNIT.encode(), OPERATOR.encode()))
        self._transport = httpx.ASGITransport(app=app, client=("10.0.0.1", 40_000))
        self.newer = dict(paths)

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        response = await self._transport.handle_async_request(request)
        data = await response.aread()
        if response.status_code != 200 or request.url.path.startswith("/cell/meshes/"):
            return httpx.Response(response.status_code, content=data)
        fields = msgpack.unpackb(data)
        if request.url.path == "/initialize":
            fields["contract_minor"] += 1
        part = self.newer.get(request.url.path)
        if part is not None and fields.get(part):
            fields[part]["newer"] = 1
        return httpx.Response(200, content=msgpack.packb(fields))


@contextlib.asynccontextmanager
async def unit_of(transport: NewerMaster, folder: Path) -> AsyncIterator[Uplink]:
    """An uplink of now at this master, whose camera's pose is known."""
    client = MasterClient("http://master", lambda: UNIT, transport=transport)
    uplink = Uplink(client, CellCache(folder), "unit of now", "boot", lambda report, delivery: None)
    uplink.set_camera(CameraInfo("A", "model", Intrinsics(8, 6, 10.0, 10.0, 4.0, 3.0)), (np.eye(4), "configured"))
    async with client:
        task = asyncio.create_task(uplink.run())
        yield uplink
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def until(look: Callable[[], bool]) -> None:
    deadline_ns = monotonic_ns() + 10 * 10**9
    while not look():
        assert monotonic_ns() < deadline_ns
        await asyncio.sleep(0.005)


def codes(master: Master) -> list[str]:
    return [cause.code for cause in master.view(monotonic_ns()).causes]


@pytest.mark.parametrize("path", [("/initialize", "settings"), ("/initialize", "lattice"), ("/cell", "board")])
async def test_a_unit_that_does_not_understand_its_master_says_so_until_it_does(
    tmp_path: Path, path: tuple[str, str]
) -> None:
    document, meshes = recorded_cell("5.0")
    document["robot"] = None
    one = Master(Cell.from_document(document, meshes), Settings())
    transport = NewerMaster(one, path)
    async with unit_of(transport, tmp_path) as uplink:
        await until(lambda: codes(one) == ["contract"])
        (row,) = one.units(monotonic_ns())
        assert row.cause is not None
        assert "update this unit" in row.reason
        assert "newer" in row.reason
        assert "update this unit" in uplink.status_text
        assert uplink.assignment is None
        # What it did not understand is taken back.
        transport.newer.clear()
        one.change_settings({"stale_after_s": 0.6})
        await until(lambda: uplink.assignment is not None)
        await until(lambda: codes(one) == ["no_frame"])
        assert uplink.assignment is not None
        assert uplink.assignment.settings.stale_after_s == 0.6


async def test_a_unit_follows_a_newer_master_until_that_asks_what_it_does_not_know(tmp_path: Path) -> None:
    document, meshes = recorded_cell("5.0")
    document["robot"] = None
    one = Master(Cell.from_document(document, meshes), Settings())
    transport = NewerMaster(one)
    async with unit_of(transport, tmp_path) as uplink:
        await until(lambda: codes(one) == ["no_frame"])
        transport.newer = {"/update": "settings", "/initialize": "settings"}
        one.change_settings({"stale_after_s": 0.6})
        await until(lambda: codes(one) == ["contract"])
        assert uplink.assignment is None


def test_a_master_of_5_0_announces_itself_without_a_minor() -> None:
    heard = offer_of("a", 8420, ["10.0.0.2"], {b"cell": b"golden", b"contract": b"5"})
    assert (heard.says.contract, heard.says.minor) == (5, 0)
    why = objection(heard, MasterCriteria(), None)
    assert why is not None
    assert "update the master first" in why
    newer = Announcement("golden", "00", CONTRACT_VERSION, minor=CONTRACT_MINOR + 1)
    told = {name.encode(): value.encode() for name, value in newer.properties().items()}
    assert objection(offer_of("a", 8420, ["10.0.0.2"], told), MasterCriteria(), None) is None
    major = replace(newer, contract=CONTRACT_VERSION + 1)
    assert "update this unit first" in (objection(replace(heard, says=major), MasterCriteria(), None) or "")


@pytest.mark.parametrize("version", VERSIONS)
def test_no_setting_of_any_minor_has_another_name_or_default(version: str) -> None:
    registered = next(step for step in answers(version) if step.path == "/initialize")
    assert keeps(Settings().model_dump(mode="json"), plain(registered)["settings"])


@pytest.mark.parametrize("version", VERSIONS)
def test_the_states_of_a_recording_of_any_minor_are_read(version: str) -> None:
    kept = json.loads((GOLDEN / version / "states.json").read_text())
    assert len(kept) == 2
    for state in kept:
        assert keeps(StateRecord.model_validate(state).model_dump(mode="json"), state)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_master_of_now_goes_on_with_the_store_of_any_minor(tmp_path: Path, version: str) -> None:
    path = tmp_path / "master.db"
    with sqlite3.connect(path) as kept:
        kept.executescript((GOLDEN / version / "master.sql").read_text())
    kept.close()
    store = Store.open(path)
    document, meshes = recorded_cell(version)
    one = Master(Cell.from_document(document, meshes), Settings(), store)
    store.close()
    (unit,) = one.registry
    assert (unit.serial, unit.record.pose_origin) == ("233522071234", "board")
    assert (one.settings.voxel_size_m, one.versions.cell) == (0.04, 2)
    assert one.cell.objects[0].T_world_mesh[0, 3] == 0.3
