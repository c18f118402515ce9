# SPDX-License-Identifier: Apache-2.0
"""The search for the master, with listeners on loopback, fake announcements and a clock that the tests set."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from edge_unit.config import UnitConfig
from edge_unit.sources.simulated import SimulatedSourceConfig
from edge_unit.uplink import master_discovery as module
from edge_unit.uplink.master_discovery import (
    COLLECT_FIRST_S,
    COLLECT_S,
    FILE_NAME,
    LOG_INTERVAL_S,
    LOST_S,
    RETRY_AFTER_S,
    SEARCH_INTERVAL_S,
    MasterSearch,
    load_last_master,
    save_last_master,
)
from edge_unit.uplink.master_selection import LastMaster, MasterAddress
from shared.discovery import Announcement, Offer
from shared.messages import CONTRACT_VERSION
from shared.waiting import within
from tests.set_clock import START_NS, S, SetClock

LOST_NS = round(LOST_S * S)

PATIENCE_S = 20.0
"""Timeout for a connection on loopback, on a busy machine. It is of the real clock, so no test measures it."""


class FakeBrowser:
    """A browser with the announcements that a test sets."""

    announced: tuple[Offer, ...] = ()
    closed: asyncio.Event

    def __init__(self) -> None:
        self.changed = asyncio.Event()

    async def __aenter__(self) -> FakeBrowser:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.closed.set()

    async def offers(self) -> tuple[Offer, ...]:
        return self.announced


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


@pytest.fixture(autouse=True)
def fake_browser(monkeypatch: pytest.MonkeyPatch, clock: SetClock) -> None:
    monkeypatch.setattr(FakeBrowser, "closed", clock.added, raising=False)
    monkeypatch.setattr(module, "Browser", FakeBrowser)
    # A busy machine can be slow to connect to itself. Each listener here answers.
    monkeypatch.setattr(module, "CONNECT_TIMEOUT_S", PATIENCE_S)
    monkeypatch.setattr(FakeBrowser, "announced", ())


def config(folder: Path, **fields: Any) -> UnitConfig:
    return UnitConfig(source=SimulatedSourceConfig(), token="x", state_dir=folder, **fields)


@asynccontextmanager
async def listening() -> AsyncIterator[int]:
    """Yield the port of a server that accepts connections."""
    server = await asyncio.start_server(lambda reader, writer: writer.close(), "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1]


@asynccontextmanager
async def running(config: UnitConfig, clock: SetClock) -> AsyncIterator[MasterSearch]:
    search = await asyncio.to_thread(MasterSearch, config, clock)
    task = asyncio.create_task(search.run())
    try:
        yield search
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def offer(port: int, cell: str = "demo") -> Offer:
    return Offer(f"{cell} at {port}", Announcement(cell, "00" * 8, CONTRACT_VERSION), ("127.0.0.1",), port)


async def pass_time(search: MasterSearch, clock: SetClock, seconds: float) -> None:
    """Advance the clock by `seconds` in the steps of the search, at most until an address is chosen."""
    end_ns = clock.now + round(seconds * S)

    async def idle() -> None:
        while search.lost and clock.due_ns() is None:
            clock.added.clear()
            await clock.added.wait()

    while True:
        assert await within(PATIENCE_S, idle())
        due_ns = clock.due_ns()
        if due_ns is None or due_ns > end_ns:
            break
        clock.step()
    if search.lost:
        clock.go_to(end_ns)


def lose(search: MasterSearch, clock: SetClock) -> None:
    """Report no answer for so long that the master is lost."""
    search.unanswered(clock.now)
    clock.go_to(clock.now + LOST_NS - 1)
    search.unanswered(clock.now)
    assert not search.lost
    clock.go_to(clock.now + 1)
    search.unanswered(clock.now)
    assert search.lost


async def test_a_unit_without_a_known_master_uses_an_announced_one(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with listening() as port, running(config(tmp_path), clock) as search:
        await pass_time(search, clock, 60.0)
        assert search.lost
        announced_ns = clock.now
        monkeypatch.setattr(FakeBrowser, "announced", (offer(port),))
        await pass_time(search, clock, 60.0)
        assert not search.lost
        # Measured from the last search without an announcement. All masters have answered since.
        assert COLLECT_FIRST_S <= (clock.now - announced_ns) / S <= COLLECT_FIRST_S + SEARCH_INTERVAL_S
        address = await search.address()
        assert address == MasterAddress(f"http://127.0.0.1:{port}", f"announced as 'demo at {port}'")
        await search.keep(address.url, "demo")
    last_master = await asyncio.to_thread(load_last_master, tmp_path / FILE_NAME)
    assert last_master == LastMaster(address.url, "demo", address.found_by)
    # After a restart the unit uses this address at once.
    search = await asyncio.to_thread(MasterSearch, config(tmp_path))
    assert await search.address() == MasterAddress(address.url, "as before")


async def test_a_silent_master_is_replaced_by_one_of_the_same_cell(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = "http://127.0.0.1:9"
    async with listening() as port, running(config(tmp_path, master_url=old), clock) as search:
        await search.keep(old, "demo")
        search.answered(old)
        monkeypatch.setattr(FakeBrowser, "announced", (offer(port, "other"), offer(port)))
        lose(search, clock)
        await pass_time(search, clock, 60.0)
        assert (await search.address()).found_by == f"announced as 'demo at {port}'"
        assert clock.now == START_NS + LOST_NS + round(COLLECT_S * S)


async def test_an_address_that_failed_is_not_tried_again_at_once(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with listening() as first, listening() as second, running(config(tmp_path), clock) as search:
        monkeypatch.setattr(FakeBrowser, "announced", (offer(first),))
        await pass_time(search, clock, 60.0)
        failed = await search.address()
        monkeypatch.setattr(FakeBrowser, "announced", (offer(first), offer(second)))
        lose(search, clock)
        await pass_time(search, clock, 60.0)
        taken, taken_ns = await search.address(), clock.now
        assert taken.url == f"http://127.0.0.1:{second}"
        # The first address never answered and is not tried before its pause ends, so the second stays in use.
        lose(search, clock)
        again_ns = taken_ns + round(RETRY_AFTER_S * S)
        await pass_time(search, clock, (again_ns - 1 - clock.now) / S)
        assert await search.address() == taken
        assert search.lost
        await pass_time(search, clock, 60.0)
        assert await search.address() == failed
        assert again_ns <= clock.now <= again_ns + round(SEARCH_INTERVAL_S * S)


async def test_a_saved_master_does_not_override_a_changed_configuration(tmp_path: Path, clock: SetClock) -> None:
    async with listening() as port:
        last_master = LastMaster(f"http://127.0.0.1:{port}", "demo", "configured", "http://127.0.0.1:7")
        await asyncio.to_thread(save_last_master, tmp_path / FILE_NAME, last_master)
        async with running(config(tmp_path, master_url="http://127.0.0.1:9"), clock) as search:
            lose(search, clock)
            await pass_time(search, clock, 60.0)
            assert search.lost
            assert (await search.address()).url == "http://127.0.0.1:9"


async def test_foreign_masters_do_not_flood_the_log(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    searches = 20
    async with running(config(tmp_path, cell="demo"), clock) as search:
        monkeypatch.setattr(FakeBrowser, "announced", (offer(1, "foreign"),))
        await pass_time(search, clock, COLLECT_S)
        for number in range(searches):
            monkeypatch.setattr(FakeBrowser, "announced", (offer(1, f"cell{number}"),))
            await pass_time(search, clock, SEARCH_INTERVAL_S)
    lines = [record for record in caplog.records if record.name == module.__name__]
    assert len(lines) == 1 + searches * SEARCH_INTERVAL_S // LOG_INTERVAL_S


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"url": "ftp://x"}',
        '{"url": "x", "cell": "y", "found_by": "z", "configured": null}',
        "9" * 20_000,
    ],
)
def test_a_damaged_file_is_ignored(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE_NAME).write_text(text)
    assert load_last_master(tmp_path / FILE_NAME) is None
    assert load_last_master(tmp_path / "gone.json") is None


def test_a_folder_that_cannot_be_written_causes_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    save_last_master(tmp_path / "file" / FILE_NAME, LastMaster("http://a:1", "demo", "configured"))
    assert "cannot be written" in caplog.text
