# SPDX-License-Identifier: Apache-2.0
"""Where a unit turns to, with masters that listen on loopback and announcements that a test makes up."""

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
from edge_unit.uplink.master_discovery import FILE_NAME, LOST_S, VAIN_S, MasterSearch, load_kept, save_kept
from edge_unit.uplink.master_selection import Kept, Place
from shared.clock import NS_PER_S, monotonic_ns
from shared.discovery import Announcement, Offer
from shared.messages import CONTRACT_VERSION

pytestmark = pytest.mark.alone

LOST_NS = round(LOST_S * NS_PER_S)


class FakeBrowser:
    """Hears what a test says."""

    heard: tuple[Offer, ...] = ()

    def __init__(self) -> None:
        self.changed = asyncio.Event()

    async def __aenter__(self) -> FakeBrowser:
        return self

    async def __aexit__(self, *_: object) -> None:
        return

    async def offers(self) -> tuple[Offer, ...]:
        return self.heard


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "Browser", FakeBrowser)
    monkeypatch.setattr(module, "HEAR_S", 0.0)
    monkeypatch.setattr(module, "HEAR_FIRST_S", 0.0)
    monkeypatch.setattr(module, "LOOK_S", 0.02)
    monkeypatch.setattr(FakeBrowser, "heard", ())


def config(folder: Path, **fields: Any) -> UnitConfig:
    return UnitConfig(source=SimulatedSourceConfig(), token="x", state_dir=folder, **fields)


@asynccontextmanager
async def listening() -> AsyncIterator[int]:
    """The port of somebody who takes connections."""
    server = await asyncio.start_server(lambda reader, writer: writer.close(), "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1]


@asynccontextmanager
async def running(config: UnitConfig) -> AsyncIterator[MasterSearch]:
    search = await asyncio.to_thread(MasterSearch, config)
    task = asyncio.create_task(search.run())
    try:
        yield search
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def offer(port: int, cell: str = "demo") -> Offer:
    return Offer(f"{cell} at {port}", Announcement(cell, "00" * 8, CONTRACT_VERSION), ("127.0.0.1",), port)


async def place_other_than(search: MasterSearch, url: str) -> Place:
    deadline_ns = monotonic_ns() + 5 * NS_PER_S
    while (place := await search.place()).url == url:
        assert monotonic_ns() < deadline_ns
        await asyncio.sleep(0.01)
    return place


async def test_an_announced_master_is_taken_by_a_unit_that_knows_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with listening() as port, running(config(tmp_path)) as search:
        assert search.lost
        monkeypatch.setattr(FakeBrowser, "heard", (offer(port),))
        place = await search.place()
        assert place == Place(f"http://127.0.0.1:{port}", f"announced as 'demo at {port}'")
        await search.keep(place.url, "demo")
        assert not search.lost
    kept = await asyncio.to_thread(load_kept, tmp_path / FILE_NAME)
    assert kept == Kept(place.url, "demo", place.found_by)
    # After a restart it goes there at once.
    search = await asyncio.to_thread(MasterSearch, config(tmp_path))
    assert await search.place() == Place(place.url, "as before")


async def test_the_same_cells_master_elsewhere_takes_the_place_of_one_that_is_silent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = "http://127.0.0.1:9"
    async with listening() as port, running(config(tmp_path, master_url=old)) as search:
        await search.keep(old, "demo")
        search.answered(old)
        monkeypatch.setattr(FakeBrowser, "heard", (offer(port, "other"), offer(port)))
        now_ns = monotonic_ns()
        search.unanswered(now_ns)
        assert not search.lost
        search.unanswered(now_ns + LOST_NS)
        assert search.lost
        assert (await place_other_than(search, old)).found_by == f"announced as 'demo at {port}'"


async def test_what_was_tried_in_vain_is_not_tried_again_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = "http://127.0.0.1:9"
    async with listening() as first, listening() as second, running(config(tmp_path)) as search:
        monkeypatch.setattr(FakeBrowser, "heard", (offer(first),))
        vain = await search.place()
        monkeypatch.setattr(FakeBrowser, "heard", (offer(first), offer(second)))
        now_ns = monotonic_ns()
        for later_ns in (0, LOST_NS):
            search.unanswered(now_ns + later_ns)
        taken = await place_other_than(search, vain.url)
        assert taken.url == f"http://127.0.0.1:{second}" != old
        # The other one, which never answered, waits for its time, and so it stays.
        for later_ns in (0, LOST_NS):
            search.unanswered(now_ns + later_ns)
        await asyncio.sleep(0.2)
        assert (await search.place()).url == taken.url
        assert search.lost
        monkeypatch.setattr(module, "monotonic_ns", lambda: monotonic_ns() + round(VAIN_S * NS_PER_S))
        assert await place_other_than(search, taken.url) == vain


async def test_a_change_of_configuration_is_not_undone_by_what_was_kept(tmp_path: Path) -> None:
    async with listening() as port:
        kept = Kept(f"http://127.0.0.1:{port}", "demo", "configured", "http://127.0.0.1:7")
        await asyncio.to_thread(save_kept, tmp_path / FILE_NAME, kept)
        async with running(config(tmp_path, master_url="http://127.0.0.1:9")) as search:
            now_ns = monotonic_ns()
            for later_ns in (0, LOST_NS):
                search.unanswered(now_ns + later_ns)
            await asyncio.sleep(0.2)
            assert (await search.place()).url == "http://127.0.0.1:9"


async def test_the_journal_is_not_filled_by_strangers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    async with running(config(tmp_path, cell="demo")):
        for number in range(20):
            monkeypatch.setattr(FakeBrowser, "heard", (offer(1, f"cell{number}"),))
            await asyncio.sleep(0.03)
    assert len([record for record in caplog.records if record.name == module.__name__]) == 1


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
