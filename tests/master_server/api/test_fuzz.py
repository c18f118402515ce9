# SPDX-License-Identifier: Apache-2.0
"""Invalid updates: the master goes on, no other unit's data changes, and no memory leaks."""

from __future__ import annotations

import gc
import logging
import random
import tracemalloc
from typing import Any

import numpy as np
import pytest

from master_server.app import make_app
from master_server.security import Access
from master_server.security import rate_limits as limits_module
from shared.clock import monotonic_ns
from shared.messages import DONE, Ended, Outcome
from shared.wire import MEDIA_TYPE, encode_update
from tests.master_server.api.fuzzing import mutated
from tests.master_server.fakes import FakeUnit, master, sees_all
from tests.master_server.test_app import OPERATOR, UNIT, Desk

SHORT, LONG = 3_000, 100_000
SEED = 20_24
WARM_UP = 1_000
GROWTH_MAX_BYTES = 2**18
"""Bound for any number of bodies; a leak of one object per body would be a hundred times as much."""

STRANGERS = 50
"""Addresses without a slot that also send."""


async def send(app: Any, body: bytes, ip: str) -> int:
    """Send the body to the application as a server would; return the status."""
    statuses = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": body, "more_body": False}

    async def take(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            statuses.append(message["status"])

    headers = [
        (b"authorization", b"Bearer " + UNIT.encode()),
        (b"content-type", MEDIA_TYPE.encode()),
        (b"content-length", str(len(body)).encode()),
    ]
    scope = {
        "type": "http", "method": "POST", "path": "/update", "raw_path": b"/update", "query_string": b"",
        "headers": headers, "client": (ip, 40_000), "server": ("master", 80), "scheme": "http", "http_version": "1.1",
        "root_path": "", "asgi": {"version": "3.0"},
    }  # fmt: skip
    await app(scope, receive, take)
    assert len(statuses) == 1
    return int(statuses[0])


def corpus(unit: FakeUnit) -> list[bytes]:
    """Return real updates: with and without voxels, with a seen report, with trouble, and a first one."""
    now_ns = monotonic_ns()
    rng = np.random.default_rng(1)
    few, many = rng.choice(8000, 20, replace=False), rng.choice(8000, 500, replace=False)
    requests = [
        unit.request(now_ns),
        unit.request(now_ns, few.tolist()),
        unit.request(now_ns, many.tolist(), seen=sees_all(unit.master)),
        unit.request(now_ns, captured_at_ns=None, exchange=None),
        unit.request(now_ns, done=(Ended.of(1, DONE), Ended.of(2, Outcome("failed", "no light")))),
    ]
    return [encode_update(request) for request in requests]


def known_of(desk: Desk, unit: FakeUnit) -> tuple[Any, ...]:
    """Return all that the master knows of one unit, except its age."""
    state = desk.app.services.master
    slot = next(slot for slot in state.registry if slot.id == unit.initialized.id)
    keys, _ = state.map.voxels()
    reported, session = state.map.keys_of(slot.id).tolist(), slot.session
    return (
        slot.id, slot.ip, slot.serial, session.number, session.sequence, reported, slot.T_world_camera,
        slot.pose_version, session.versions, session.health, list(slot.commands), state.coverage.has(slot.id),
        state.coverage.seen_by([slot.id]).tobytes(), set(reported) <= set(keys.tolist()),
    )  # fmt: skip


@pytest.mark.parametrize("count", [SHORT, pytest.param(LONG, marks=pytest.mark.slow)])
async def test_mutated_updates(count: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    # Kept by pytest, not by the master.
    caplog.set_level(logging.ERROR, "master_server")
    # The rate limit is not under test here.
    monkeypatch.setattr(limits_module, "REQUESTS_BURST", 10**9)
    watched = master(with_robot=False, stale_after_s=60.0)
    desk = Desk(make_app(watched, Access(UNIT.encode(), OPERATOR.encode())))
    good = await desk.register("10.0.0.1", "good")
    assert (await desk.update(good, 5, 7, 4000, seen=sees_all(watched))).status_code == 200
    bad = await desk.register("10.0.0.2", "bad")
    bodies = corpus(bad)
    before, settings, versions = known_of(desk, good), watched.settings, watched.versions
    rng = random.Random(SEED)
    addresses = ["10.0.0.2", *(f"10.0.1.{number}" for number in range(STRANGERS))]
    statuses: dict[int, int] = {}
    before_bytes = 0
    snapshot: tracemalloc.Snapshot | None = None
    tracemalloc.start()
    try:
        for number in range(count):
            if number == WARM_UP:
                gc.collect()
                snapshot = tracemalloc.take_snapshot()
                before_bytes = tracemalloc.get_traced_memory()[0]
            body = mutated(rng, bodies)
            ip = "10.0.0.2" if number % 2 else rng.choice(addresses)
            status = await send(desk.app, body, ip)
            statuses[status] = statuses.get(status, 0) + 1
            assert status < 500, body
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before_bytes
        assert snapshot is not None
        where = "\n".join(map(str, tracemalloc.take_snapshot().compare_to(snapshot, "lineno")[:5]))
    finally:
        tracemalloc.stop()
    assert statuses[422] > count // 10
    assert known_of(desk, good) == before
    assert (watched.settings, watched.versions) == (settings, versions)
    assert {slot.ip for slot in watched.registry} == {"10.0.0.1", "10.0.0.2"}
    assert grown < GROWTH_MAX_BYTES, f"{grown} bytes more after {count} bodies:\n{where}"
    assert (await desk.update(good, 9)).status_code == 200
