# SPDX-License-Identifier: Apache-2.0
"""The search for a master: masters that listen on loopback, made-up announcements, and a set clock."""

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
    FILE_NAME,
    HEAR_FIRST_S,
    HEAR_S,
    LOOK_S,
    LOST_S,
    TELL_S,
    VAIN_S,
    MasterSearch,
    load_kept,
    save_kept,
)
from edge_unit.uplink.master_selection import Kept, Place
from shared.discovery import Announcement, Offer
from shared.messages import CONTRACT_VERSION
from shared.waiting import within
from tests.set_clock import START_NS, S, SetClock

LOST_NS = round(LOST_S * S)

PATIENCE_S = 20.0
"""Timeout of a connection on loopback, by the real clock; it is not measured."""


class FakeBrowser:
    """A listener that receives the announcements of a test."""

    heard: tuple[Offer, ...] = ()
    closed: asyncio.Event

    def __init__(self) -> None:
        self.changed = asyncio.Event()

    async def __aenter__(self) -> FakeBrowser:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.closed.set()

    async def offers(self) -> tuple[Offer, ...]:
        return self.heard


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


@pytest.fixture(autouse=True)
def made_up(monkeypatch: pytest.MonkeyPatch, clock: SetClock) -> None:
    monkeypatch.setattr(FakeBrowser, "closed", clock.added, raising=False)
    monkeypatch.setattr(module, "Browser", FakeBrowser)
    # A busy machine may be slow to connect to itself; every server here answers.
    monkeypatch.setattr(module, "REACH_S", PATIENCE_S)
    monkeypatch.setattr(FakeBrowser, "heard", ())


def config(folder: Path, **fields: Any) -> UnitConfig:
    return UnitConfig(source=SimulatedSourceConfig(), token="x", state_dir=folder, **fields)


@asynccontextmanager
async def listening() -> AsyncIterator[int]:
    """The port of a server that accepts connections."""
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
    """Advance the clock from search to search, until so much time has passed or an address is used."""
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
    """Let the master not answer until it is lost."""
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
        monkeypatch.setattr(FakeBrowser, "heard", (offer(port),))
        await pass_time(search, clock, 60.0)
        assert not search.lost
        # Since the search without any announcement; every master has answered since.
        assert HEAR_FIRST_S <= (clock.now - heard_ns) / S <= HEAR_FIRST_S + LOOK_S
        place = await search.place()
        assert place == Place(f"http://127.0.0.1:{port}", f"announced as 'demo at {port}'")
        await search.keep(place.url, "demo")
    kept = await asyncio.to_thread(load_kept, tmp_path / FILE_NAME)
    assert kept == Kept(place.url, "demo", place.found_by)
    # After a restart this address is used at once.
    search = await asyncio.to_thread(MasterSearch, config(tmp_path))
    assert await search.place() == Place(place.url, "as before")


async def test_the_same_cells_master_elsewhere_takes_the_place_of_one_that_is_silent(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = "http://127.0.0.1:9"
    async with listening() as port, running(config(tmp_path, master_url=old), clock) as search:
        await search.keep(old, "demo")
        search.answered(old)
        monkeypatch.setattr(FakeBrowser, "heard", (offer(port, "other"), offer(port)))
        lose(search, clock)
        await pass_time(search, clock, 60.0)
        assert (await search.place()).found_by == f"announced as 'demo at {port}'"
        assert clock.now == START_NS + LOST_NS + round(HEAR_S * S)


async def test_what_was_tried_in_vain_is_not_tried_again_at_once(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with listening() as first, listening() as second, running(config(tmp_path), clock) as search:
        monkeypatch.setattr(FakeBrowser, "heard", (offer(first),))
        await pass_time(search, clock, 60.0)
        vain = await search.place()
        monkeypatch.setattr(FakeBrowser, "heard", (offer(first), offer(second)))
        lose(search, clock)
        await pass_time(search, clock, 60.0)
        taken, taken_ns = await search.place(), clock.now
        assert taken.url == f"http://127.0.0.1:{second}"
        # The other one never answered and is paused, so the address stays.
        lose(search, clock)
        again_ns = taken_ns + round(VAIN_S * S)
        await pass_time(search, clock, (again_ns - 1 - clock.now) / S)
        assert await search.place() == taken
        assert search.lost
        await pass_time(search, clock, 60.0)
        assert await search.place() == vain
        assert again_ns <= clock.now <= again_ns + round(LOOK_S * S)


async def test_a_change_of_configuration_is_not_undone_by_what_was_kept(tmp_path: Path, clock: SetClock) -> None:
    async with listening() as port:
        kept = Kept(f"http://127.0.0.1:{port}", "demo", "configured", "http://127.0.0.1:7")
        await asyncio.to_thread(save_kept, tmp_path / FILE_NAME, kept)
        async with running(config(tmp_path, master_url="http://127.0.0.1:9"), clock) as search:
            lose(search, clock)
            await pass_time(search, clock, 60.0)
            assert search.lost
            assert (await search.place()).url == "http://127.0.0.1:9"


async def test_the_journal_is_not_filled_by_strangers(
    tmp_path: Path, clock: SetClock, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    looks = 20
    async with running(config(tmp_path, cell="demo"), clock) as search:
        monkeypatch.setattr(FakeBrowser, "heard", (offer(1, "stranger"),))
        await pass_time(search, clock, HEAR_S)
        for number in range(looks):
            monkeypatch.setattr(FakeBrowser, "heard", (offer(1, f"cell{number}"),))
            await pass_time(search, clock, LOOK_S)
    lines = [record for record in caplog.records if record.name == module.__name__]
    assert len(lines) == 1 + looks * LOOK_S // TELL_S


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
    assert load_kept(tmp_path / FILE_NAME) is None
    assert load_kept(tmp_path / "gone.json") is None


def test_a_folder_that_cannot_be_written_costs_the_memory_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    save_kept(tmp_path / "file" / FILE_NAME, Kept("http://a:1", "demo", "configured"))
    assert "cannot be written" in caplog.text
