# SPDX-License-Identifier: Apache-2.0
"""Where a unit turns to: masters that listen on loopback, announcements and a clock that a test makes up."""

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
"""For a connection on loopback, on a busy machine; by the real clock, and so never measured."""


class FakeBrowser:
    """Hears what a test says."""

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
def made_up(monkeypatch: pytest.MonkeyPatch, clock: SetClock) -> None:
    monkeypatch.setattr(FakeBrowser, "closed", clock.added, raising=False)
    monkeypatch.setattr(module, "Browser", FakeBrowser)
    # A busy machine may be slow to connect to itself; nobody here listens without answering.
    monkeypatch.setattr(module, "CONNECT_TIMEOUT_S", PATIENCE_S)
    monkeypatch.setattr(FakeBrowser, "announced", ())


def config(folder: Path, **fields: Any) -> UnitConfig:
    return UnitConfig(source=SimulatedSourceConfig(), token="x", state_dir=folder, **fields)


@asynccontextmanager
async def listening() -> AsyncIterator[int]:
    """The port of somebody who takes connections."""
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
    """Let so much time pass, look by look; the time at which an address is taken is the end of it."""
    end_ns = clock.now + round(seconds * S)

    async def rests() -> None:
        while search.lost and clock.due_ns() is None:
            clock.added.clear()
            await clock.added.wait()

    while True:
        assert await within(PATIENCE_S, rests())
        due_ns = clock.due_ns()
        if due_ns is None or due_ns > end_ns:
            break
        clock.step()
    if search.lost:
        clock.go_to(end_ns)


def lose(search: MasterSearch, clock: SetClock) -> None:
    """Have the master not answer for so long that it is lost."""
    search.unanswered(clock.now)
    clock.go_to(clock.now + LOST_NS - 1)
    search.unanswered(clock.now)
    assert not search.lost
    clock.go_to(clock.now + 1)
    search.unanswered(clock.now)
    assert search.lost


async def test_an_announced_master_is_taken_by_a_unit_that_knows_none(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with listening() as port, running(config(tmp_path), clock) as search:
        await pass_time(search, clock, 60.0)
        assert search.lost
        heard_ns = clock.now
        monkeypatch.setattr(FakeBrowser, "announced", (offer(port),))
        await pass_time(search, clock, 60.0)
        assert not search.lost
        # From the look at which nobody was announced yet; all who are there have answered since.
        assert COLLECT_FIRST_S <= (clock.now - heard_ns) / S <= COLLECT_FIRST_S + SEARCH_INTERVAL_S
        address = await search.address()
        assert address == MasterAddress(f"http://127.0.0.1:{port}", f"announced as 'demo at {port}'")
        await search.keep(address.url, "demo")
    last_master = await asyncio.to_thread(load_last_master, tmp_path / FILE_NAME)
    assert last_master == LastMaster(address.url, "demo", address.found_by)
    # After a restart it goes there at once.
    search = await asyncio.to_thread(MasterSearch, config(tmp_path))
    assert await search.address() == MasterAddress(address.url, "as before")


async def test_the_same_cells_master_elsewhere_takes_the_place_of_one_that_is_silent(
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


async def test_what_was_tried_in_vain_is_not_tried_again_at_once(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with listening() as first, listening() as second, running(config(tmp_path), clock) as search:
        monkeypatch.setattr(FakeBrowser, "announced", (offer(first),))
        await pass_time(search, clock, 60.0)
        vain = await search.address()
        monkeypatch.setattr(FakeBrowser, "announced", (offer(first), offer(second)))
        lose(search, clock)
        await pass_time(search, clock, 60.0)
        taken, taken_ns = await search.address(), clock.now
        assert taken.url == f"http://127.0.0.1:{second}"
        # The other one, which never answered, waits for its time, and so it stays.
        lose(search, clock)
        again_ns = taken_ns + round(RETRY_AFTER_S * S)
        await pass_time(search, clock, (again_ns - 1 - clock.now) / S)
        assert await search.address() == taken
        assert search.lost
        await pass_time(search, clock, 60.0)
        assert await search.address() == vain
        assert again_ns <= clock.now <= again_ns + round(SEARCH_INTERVAL_S * S)


async def test_a_change_of_configuration_is_not_undone_by_what_was_kept(tmp_path: Path, clock: SetClock) -> None:
    async with listening() as port:
        last_master = LastMaster(f"http://127.0.0.1:{port}", "demo", "configured", "http://127.0.0.1:7")
        await asyncio.to_thread(save_last_master, tmp_path / FILE_NAME, last_master)
        async with running(config(tmp_path, master_url="http://127.0.0.1:9"), clock) as search:
            lose(search, clock)
            await pass_time(search, clock, 60.0)
            assert search.lost
            assert (await search.address()).url == "http://127.0.0.1:9"


async def test_the_journal_is_not_filled_by_strangers(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    looks = 20
    async with running(config(tmp_path, cell="demo"), clock) as search:
        monkeypatch.setattr(FakeBrowser, "announced", (offer(1, "stranger"),))
        await pass_time(search, clock, COLLECT_S)
        for number in range(looks):
            monkeypatch.setattr(FakeBrowser, "announced", (offer(1, f"cell{number}"),))
            await pass_time(search, clock, SEARCH_INTERVAL_S)
    lines = [record for record in caplog.records if record.name == module.__name__]
    assert len(lines) == 1 + looks * SEARCH_INTERVAL_S // LOG_INTERVAL_S


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
def test_a_damaged_file_is_as_good_as_none(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE_NAME).write_text(text)
    assert load_last_master(tmp_path / FILE_NAME) is None
    assert load_last_master(tmp_path / "gone.json") is None


def test_a_folder_that_cannot_be_written_costs_the_memory_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    save_last_master(tmp_path / "file" / FILE_NAME, LastMaster("http://a:1", "demo", "configured"))
    assert "cannot be written" in caplog.text
