# SPDX-License-Identifier: Apache-2.0
"""Listeners without a network, by the real clock."""

from __future__ import annotations

import asyncio
import itertools
import logging
from typing import Any

import msgpack
import pytest

from master_server.api import map_stream as stream_module
from master_server.api.map_stream import HEARTBEAT_NS, MAX_LISTENERS, PERIOD_MIN_NS, Listener, Stream, Wish
from master_server.api.responses import StreamMessage
from master_server.core import Master
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import Refusal
from shared.messages import JointsRequest
from shared.waiting import within
from tests.master_server.fakes import MS, FakeUnit, joined, master, sees_all

pytestmark = pytest.mark.alone

KEYS = Wish("keys")
SLACK_NS = 50 * MS
"""What the push of a moment that has come may take."""


@pytest.fixture
def robotic() -> Master:
    """A master of a cell with a robot; it reads files, so not in a loop."""
    return master(with_robot=True, robot_stale_after_s=0.4)


async def heard(listener: Listener) -> dict[str, Any]:
    """The next message, which every listener has within a heartbeat."""
    messages: list[bytes | str] = []

    async def take() -> None:
        messages.append(await listener.next())

    assert await within(2 * HEARTBEAT_NS / NS_PER_S, take())
    assert isinstance(messages[0], bytes)
    found: dict[str, Any] = msgpack.unpackb(messages[0])
    StreamMessage.model_validate(found)
    return found


def live(one: Master, number: int = 1, *keys: int) -> FakeUnit:
    unit = joined(one, number, monotonic_ns())
    unit.update(monotonic_ns(), keys, seen=sees_all(one), age_ns=MS)
    return unit


async def test_the_first_message_comes_at_once_and_each_change_after_it() -> None:
    one = master()
    unit = live(one, 1, 5)
    stream = Stream(one)
    with stream.listen(KEYS) as listener:
        began_ns = monotonic_ns()
        first = await heard(listener)
        assert (first["voxels"], first["witnesses"], first["complete"]) == ([5], [1], True)
        assert [(row["id"], row["state"], row["voxels"]) for row in first["units"]] == [(1, "live", 1)]
        unit.update(monotonic_ns(), [6, 7], age_ns=MS)
        second = await heard(listener)
        assert second["voxels"] == [6, 7]
        assert second["number"] == first["number"] + 1
        assert monotonic_ns() - began_ns < HEARTBEAT_NS // 2
    assert len(stream) == 0


async def test_what_an_operator_and_the_robot_do_is_told_too(robotic: Master) -> None:
    unit = live(robotic, 1, 5)
    with Stream(robotic).listen(KEYS) as listener:
        assert (await heard(listener))["reasons"] == ["the robot has not reported its joints yet"]
        robotic.put_joints(JointsRequest(positions=(0.0, 0.0)), monotonic_ns())
        assert (await heard(listener))["complete"]
        robotic.change_settings({"voxel_size_m": 0.1})
        changed = await heard(listener)
        assert changed["lattice"]["voxel_size_m"] == 0.1
        assert changed["voxels"] == []
        robotic.forget(unit.initialized.id)
        assert (await heard(listener))["units"] == []


@pytest.mark.parametrize("stale_after_s", [0.06, 0.3])
async def test_a_unit_that_falls_silent_is_told_at_its_moment(stale_after_s: float) -> None:
    one = master(stale_after_s=stale_after_s)
    stream = Stream(one)
    live(one, 1, 5)
    captured_ns = monotonic_ns() - MS
    with stream.listen(KEYS) as listener:
        message = await heard(listener)
        while message["complete"]:
            message = await heard(listener)
        late_ns = message["now_ns"] - captured_ns - round(stale_after_s * NS_PER_S)
        assert -2 * MS < late_ns < SLACK_NS
        assert message["voxels"] == []
        assert message["units"][0]["state"] == "stale"


async def test_a_robot_that_falls_silent_is_told_at_its_moment(robotic: Master) -> None:
    robotic.change_settings({"stale_after_s": 60.0})
    live(robotic, 1, 5)
    put_ns = monotonic_ns()
    robotic.put_joints(JointsRequest(positions=(0.0, 0.0)), put_ns)
    with Stream(robotic).listen(KEYS) as listener:
        assert (await heard(listener))["complete"]
        message = await heard(listener)
        assert not message["complete"]
        assert message["now_ns"] - put_ns < 400 * MS + SLACK_NS


async def test_without_any_change_there_is_a_heartbeat() -> None:
    with Stream(master()).listen(KEYS) as listener:
        first, second = await heard(listener), await heard(listener)
        assert second["number"] == first["number"] + 1
        assert second["now_ns"] - first["now_ns"] == pytest.approx(HEARTBEAT_NS, abs=SLACK_NS)
        assert second["reasons"] == ["there is no unit"]


async def test_many_updates_make_few_messages() -> None:
    one = master()
    unit = live(one)
    with Stream(one).listen(KEYS) as listener:
        await heard(listener)
        times_ns = []
        for _ in range(5):
            for key in range(20):
                unit.update(monotonic_ns(), [key], age_ns=MS)
            message = await heard(listener)
            assert message["voxels"] == [19]
            times_ns.append(message["now_ns"])
        gaps_ns = [b - a for a, b in itertools.pairwise(times_ns)]
        assert min(gaps_ns) >= PERIOD_MIN_NS - MS
        assert listener.skipped == 0


async def test_who_comes_late_has_the_newest_and_the_others_missed_nothing() -> None:
    one = master()
    unit = live(one)
    stream = Stream(one)
    with stream.listen(KEYS) as slow, stream.listen(KEYS) as quick:
        await heard(slow)
        await heard(quick)
        for key in range(1, 6):
            unit.update(monotonic_ns(), [key], age_ns=MS)
            assert (await heard(quick))["voxels"] == [key]
        assert (await heard(slow))["voxels"] == [5]
        assert (quick.skipped, slow.skipped) == (0, 4)
        assert (quick.sent, slow.sent) == (6, 2)


async def test_listeners_of_one_wish_share_one_encoding(monkeypatch: pytest.MonkeyPatch) -> None:
    encoded: list[str] = []
    original = stream_module.map_fields

    def counted(view: Any, form: Any, unseen: Any, now_ns: int) -> dict[str, Any]:
        encoded.append(form)
        return original(view, form, unseen, now_ns)

    monkeypatch.setattr(stream_module, "map_fields", counted)
    one = master()
    live(one, 1, 411)
    stream = Stream(one)
    listeners = [stream.listen(wish) for wish in (KEYS, KEYS, KEYS, Wish("centres"), Wish("keys", "json"))]
    messages = [await listener.next() for listener in listeners]
    assert messages[0] is messages[1] is messages[2]
    assert sorted(encoded) == ["centres", "keys", "keys"]
    assert msgpack.unpackb(messages[3])["voxels"] == [[0.075, 0.075, 0.075]]
    assert isinstance(messages[4], str)


async def test_unseen_blocks_only_for_who_wants_them() -> None:
    one = master()
    joined(one, 1, monotonic_ns()).update(monotonic_ns(), age_ns=MS)
    stream = Stream(one)
    with stream.listen(KEYS) as without, stream.listen(Wish("keys", unseen=True)) as with_unseen:
        assert (await heard(without))["unseen"] is None
        assert len((await heard(with_unseen))["unseen"]["blocks"]) == 10 * 20 * 5


async def test_there_is_an_end_to_listeners() -> None:
    stream = Stream(master())
    listeners = [stream.listen(KEYS) for _ in range(MAX_LISTENERS)]
    with pytest.raises(Refusal, match=str(MAX_LISTENERS)) as caught:
        stream.listen(KEYS)
    assert caught.value.status == 503
    stream.forget(listeners[0])
    stream.listen(KEYS)


async def test_a_fault_costs_one_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    one = master()
    faults: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: faults.append(context))
    view = one.view

    def faulty(now_ns: int) -> Any:
        monkeypatch.setattr(one, "view", view)
        raise RuntimeError("once")

    with Stream(one).listen(KEYS) as listener:
        monkeypatch.setattr(one, "view", faulty)
        assert (await heard(listener))["units_live"] == 0
    assert [str(fault["exception"]) for fault in faults] == ["once"]


async def test_what_costs_much_comes_rarely_but_with_each_heartbeat(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_module, "COST_SHARE_MAX", 1e-6)
    one = master(stale_after_s=60.0)
    unit = live(one, 1, 1)
    with Stream(one).listen(KEYS) as listener:
        first = await heard(listener)
        unit.update(monotonic_ns(), [2], age_ns=MS)
        second = await heard(listener)
        assert second["voxels"] == [2]
        assert second["now_ns"] - first["now_ns"] == pytest.approx(HEARTBEAT_NS, abs=SLACK_NS)


async def test_states_are_logged_at_their_time_though_nobody_listens(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    one = master(stale_after_s=0.05)
    live(one)
    stream = Stream(one)
    stream.start()
    told = asyncio.Event()
    monotonic_began_ns = monotonic_ns()

    class Ear(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if "stale" in record.getMessage():
                told.set()

    handler = Ear()
    logging.getLogger("master_server.core.units").addHandler(handler)
    try:
        assert await within(1.0, told.wait())
    finally:
        logging.getLogger("master_server.core.units").removeHandler(handler)
        stream.stop()
    assert monotonic_ns() - monotonic_began_ns < 50 * MS + SLACK_NS
    lines = [record.getMessage() for record in caplog.records if getattr(record, "event", "") == "state"]
    assert lines[0].endswith("live")
    assert lines[1].startswith("unit 1 (10.0.0.1): live → stale: its last")
    assert len(lines) == 2
