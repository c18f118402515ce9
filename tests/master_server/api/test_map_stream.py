# SPDX-License-Identifier: Apache-2.0
"""Listeners without a network, with a clock that the test advances."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import msgpack
import pytest

from master_server.api import map_stream as stream_module
from master_server.api.map_stream import (
    DUE_SLACK_NS,
    HEARTBEAT_NS,
    MAX_LISTENERS,
    PERIOD_MIN_NS,
    Listener,
    Stream,
    StreamFormat,
)
from master_server.api.responses import StreamMessage
from master_server.core import Master
from shared.clock import NS_PER_S
from shared.errors import Refusal
from shared.messages import JointsRequest
from shared.waiting import within
from tests.master_server.fakes import MS, START_NS, FakeUnit, joined, master, sees_all
from tests.set_clock import SetClock

KEYS = StreamFormat("keys")

PATIENCE_S = 10.0
"""Timeout for a message that comes at once on an idle machine; by the real clock, so no test measures it."""


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


@pytest.fixture(autouse=True)
def snapshots_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make snapshots cost nothing: on a busy machine the stream pauses longer after one. One test sets its own cost."""
    monkeypatch.setattr(stream_module, "stage_ns", lambda: 0)


@pytest.fixture
def robotic() -> Master:
    """Return a master of a cell with a robot; it reads files, so outside of an event loop."""
    return master(with_robot=True, robot_stale_after_s=0.4)


async def received(listener: Listener) -> dict[str, Any]:
    """Return the listener's waiting message."""
    messages: list[bytes | str] = []

    async def take() -> None:
        messages.append(await listener.next())

    assert await within(PATIENCE_S, take())
    assert isinstance(messages[0], bytes)
    found: dict[str, Any] = msgpack.unpackb(messages[0])
    StreamMessage.model_validate(found)
    return found


async def next_received(clock: SetClock, listener: Listener) -> dict[str, Any]:
    """Return the message of the clock's next call."""
    at_ns = clock.step()
    message = await received(listener)
    assert message["now_ns"] == at_ns
    return message


def live(one: Master, number: int = 1, *keys: int) -> FakeUnit:
    unit = joined(one, number, START_NS)
    unit.update(START_NS, keys, seen=sees_all(one), age_ns=MS)
    return unit


async def test_the_first_message_comes_at_once_and_each_change_after_it(clock: SetClock) -> None:
    one = master()
    unit = live(one, 1, 5)
    stream = Stream(one, clock)
    with stream.listen(KEYS) as listener:
        first = await next_received(clock, listener)
        assert first["now_ns"] == START_NS
        assert (first["voxels"], first["witnesses"], first["complete"]) == ([5], [1], True)
        assert [(row["id"], row["state"], row["voxels"]) for row in first["units"]] == [(1, "live", 1)]
        clock.go_to(START_NS + 2 * PERIOD_MIN_NS)
        unit.update(clock.now, [6, 7], age_ns=MS)
        second = await next_received(clock, listener)
        assert second["now_ns"] == START_NS + 2 * PERIOD_MIN_NS
        assert second["voxels"] == [6, 7]
        assert second["number"] == first["number"] + 1
    assert len(stream) == 0


async def test_changes_by_an_operator_and_the_robot_are_sent_too(robotic: Master, clock: SetClock) -> None:
    unit = live(robotic, 1, 5)
    with Stream(robotic, clock).listen(KEYS) as listener:
        assert (await next_received(clock, listener))["reasons"] == ["the robot has not reported its joints yet"]
        robotic.put_joints(JointsRequest(positions=(0.0, 0.0)), clock.now)
        assert (await next_received(clock, listener))["complete"]
        robotic.change_settings({"voxel_size_m": 0.1})
        changed = await next_received(clock, listener)
        assert changed["lattice"]["voxel_size_m"] == 0.1
        assert changed["voxels"] == []
        robotic.forget(unit.initialized.id)
        assert (await next_received(clock, listener))["units"] == []
        assert clock.now == START_NS + 3 * PERIOD_MIN_NS


@pytest.mark.parametrize("stale_after_s", [0.06, 0.3])
async def test_a_stale_unit_is_sent_when_it_becomes_stale(stale_after_s: float, clock: SetClock) -> None:
    one = master(stale_after_s=stale_after_s)
    stream = Stream(one, clock)
    live(one, 1, 5)
    with stream.listen(KEYS) as listener:
        assert (await next_received(clock, listener))["complete"]
        message = await next_received(clock, listener)
        # Its frame was captured 1 ms before the start.
        assert message["now_ns"] == START_NS - MS + round(stale_after_s * NS_PER_S) + DUE_SLACK_NS
        assert not message["complete"]
        assert message["voxels"] == []
        assert message["units"][0]["state"] == "stale"


async def test_a_stale_robot_is_sent_when_it_becomes_stale(robotic: Master, clock: SetClock) -> None:
    robotic.change_settings({"stale_after_s": 60.0})
    live(robotic, 1, 5)
    robotic.put_joints(JointsRequest(positions=(0.0, 0.0)), START_NS)
    with Stream(robotic, clock).listen(KEYS) as listener:
        assert (await next_received(clock, listener))["complete"]
        message = await next_received(clock, listener)
        assert not message["complete"]
        assert message["now_ns"] == START_NS + 400 * MS + DUE_SLACK_NS


async def test_without_any_change_there_is_a_heartbeat(clock: SetClock) -> None:
    with Stream(master(), clock).listen(KEYS) as listener:
        first, second = await next_received(clock, listener), await next_received(clock, listener)
        assert second["number"] == first["number"] + 1
        assert second["now_ns"] - first["now_ns"] == HEARTBEAT_NS
        assert second["reasons"] == ["there is no unit"]


async def test_the_timer_is_idle_without_listeners(clock: SetClock) -> None:
    one = master()
    unit = live(one)
    stream = Stream(one, clock)
    assert clock.due_ns() is None
    with stream.listen(KEYS) as listener:
        await next_received(clock, listener)
    clock.step()
    unit.update(clock.now, [1], age_ns=MS)
    assert stream.snapshot is None
    assert clock.due_ns() is None
    with stream.listen(KEYS) as listener:
        assert (await next_received(clock, listener))["voxels"] == [1]
        stream.stop()
        assert clock.due_ns() is None


async def test_many_updates_make_few_messages(clock: SetClock) -> None:
    one = master()
    unit = live(one)
    with Stream(one, clock).listen(KEYS) as listener:
        times_ns = [(await next_received(clock, listener))["now_ns"]]
        for _ in range(5):
            for key in range(20):
                unit.update(clock.now, [key], age_ns=MS)
            message = await next_received(clock, listener)
            assert message["voxels"] == [19]
            times_ns.append(message["now_ns"])
        assert times_ns == [START_NS + number * PERIOD_MIN_NS for number in range(6)]
        assert listener.skipped == 0


async def test_a_late_listener_gets_the_newest_and_the_others_miss_nothing(clock: SetClock) -> None:
    one = master()
    unit = live(one)
    stream = Stream(one, clock)
    with stream.listen(KEYS) as slow, stream.listen(KEYS) as quick:
        clock.step()
        await received(slow)
        await received(quick)
        for key in range(1, 6):
            unit.update(clock.now, [key], age_ns=MS)
            assert (await next_received(clock, quick))["voxels"] == [key]
        assert (await received(slow))["voxels"] == [5]
        assert (quick.skipped, slow.skipped) == (0, 4)
        assert (quick.sent, slow.sent) == (6, 2)


async def test_listeners_of_one_format_share_one_encoding(monkeypatch: pytest.MonkeyPatch, clock: SetClock) -> None:
    encoded: list[str] = []
    original = stream_module.map_fields

    def counted(view: Any, form: Any, unseen: Any, now_ns: int) -> dict[str, Any]:
        encoded.append(form)
        return original(view, form, unseen, now_ns)

    monkeypatch.setattr(stream_module, "map_fields", counted)
    one = master()
    live(one, 1, 411)
    stream = Stream(one, clock)
    listeners = [
        stream.listen(stream_format)
        for stream_format in (KEYS, KEYS, KEYS, StreamFormat("centres"), StreamFormat("keys", "json"))
    ]
    clock.step()
    messages = [await listener.next() for listener in listeners]
    assert messages[0] is messages[1] is messages[2]
    assert sorted(encoded) == ["centres", "keys", "keys"]
    assert msgpack.unpackb(messages[3])["voxels"] == [[0.075, 0.075, 0.075]]
    assert isinstance(messages[4], str)


async def test_unseen_blocks_are_sent_only_on_request(clock: SetClock) -> None:
    one = master()
    joined(one, 1).update(START_NS, age_ns=MS)
    stream = Stream(one, clock)
    with stream.listen(KEYS) as without, stream.listen(StreamFormat("keys", unseen=True)) as with_unseen:
        clock.step()
        assert (await received(without))["unseen"] is None
        assert len((await received(with_unseen))["unseen"]["blocks"]) == 10 * 20 * 5


async def test_the_number_of_listeners_is_bounded(clock: SetClock) -> None:
    stream = Stream(master(), clock)
    listeners = [stream.listen(KEYS) for _ in range(MAX_LISTENERS)]
    with pytest.raises(Refusal, match=str(MAX_LISTENERS)) as caught:
        stream.listen(KEYS)
    assert caught.value.status == 503
    stream.forget(listeners[0])
    stream.listen(KEYS)


async def test_a_fault_costs_one_snapshot(monkeypatch: pytest.MonkeyPatch, clock: SetClock) -> None:
    one = master()

    def faulty(now_ns: int) -> Any:
        raise RuntimeError("once")

    with Stream(one, clock).listen(KEYS) as listener:
        with monkeypatch.context() as patch:
            patch.setattr(one, "view", faulty)
            with pytest.raises(RuntimeError, match="once"):
                clock.step()
        assert (await next_received(clock, listener))["units_live"] == 0


async def test_costly_snapshots_are_rare_but_keep_the_heartbeat(
    monkeypatch: pytest.MonkeyPatch, clock: SetClock
) -> None:
    ticks = itertools.count(0, MS)
    monkeypatch.setattr(stream_module, "stage_ns", lambda: next(ticks))
    monkeypatch.setattr(stream_module, "COST_SHARE_MAX", 1e-9)
    one = master(stale_after_s=60.0)
    unit = live(one, 1, 1)
    with Stream(one, clock).listen(KEYS) as listener:
        first = await next_received(clock, listener)
        unit.update(clock.now, [2], age_ns=MS)
        second = await next_received(clock, listener)
        assert second["voxels"] == [2]
        assert second["now_ns"] - first["now_ns"] == HEARTBEAT_NS


async def test_by_default_its_clock_is_the_machine_s() -> None:
    with Stream(master()).listen(KEYS) as listener:
        first, second = await received(listener), await received(listener)
        assert second["now_ns"] - first["now_ns"] >= HEARTBEAT_NS - MS
        assert asyncio.get_running_loop().is_running()
