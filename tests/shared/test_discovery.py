# SPDX-License-Identifier: Apache-2.0
"""Announcements: their encoding, their validation, and discovery of masters on loopback."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from ipaddress import IPv4Interface

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import discovery
from shared.discovery import (
    SERVICE_TYPE,
    AddressChanges,
    Announcement,
    Announcer,
    Browser,
    Offer,
    addresses_to_announce,
    offer_of,
)
from shared.errors import WireError
from shared.waiting import within

pytestmark = pytest.mark.alone

LOOPBACK = IPv4Interface("127.0.0.1/8")
FIRST, SECOND = IPv4Interface("10.0.0.2/24"), IPv4Interface("192.168.0.3/24")
SAYS = Announcement("demo", "ab" * 32, 3, True, "cd" * 32)


def received(says: Announcement) -> dict[bytes, bytes | None]:
    return {key.encode(): value.encode() for key, value in says.properties().items()}


def test_an_announcement_round_trip() -> None:
    offer = offer_of(f"demo at pc 1a2b.{SERVICE_TYPE}", 8420, ["10.0.0.2", "192.168.0.3"], received(SAYS))
    assert offer.name == "demo at pc 1a2b"
    assert offer.says == Announcement("demo", "ab" * 8, 3, True, "cd" * 8)
    assert offer.urls == ("https://10.0.0.2:8420", "https://192.168.0.3:8420")


def test_each_value_fits_for_any_name_of_the_cell() -> None:
    says = Announcement("\x00" + "Zelle Ä " * 60, "ab" * 32, 3)
    assert all(len(f"{key}={value}".encode()) < 256 for key, value in says.properties().items())
    offer = offer_of("x", 1, ["10.0.0.2"], received(says))
    assert offer.says.cell == discovery.shortened(says.cell)
    assert offer.says.cell.startswith("?Zelle Ä ")


@pytest.mark.parametrize(
    ("changed", "port", "addresses", "name"),
    [
        ({b"cell": b""}, 1, ["10.0.0.2"], "a"),
        ({b"cell": None}, 1, ["10.0.0.2"], "a"),
        ({b"cell": b"x" * 201}, 1, ["10.0.0.2"], "a"),
        ({b"cell": b"line\nbreak"}, 1, ["10.0.0.2"], "a"),
        ({b"contract": b"three"}, 1, ["10.0.0.2"], "a"),
        ({b"contract": b"9" * 5000}, 1, ["10.0.0.2"], "a"),
        ({}, None, ["10.0.0.2"], "a"),
        ({}, 70000, ["10.0.0.2"], "a"),
        ({}, 1, [], "a"),
        ({}, 1, ["10.0.0.2"], "a\x1b[2J"),
    ],
)
def test_invalid_announcements_are_refused(
    changed: dict[bytes, bytes | None], port: int | None, addresses: list[str], name: str
) -> None:
    with pytest.raises(WireError, match="announcement"):
        offer_of(name, port, addresses, received(SAYS) | changed)


@given(
    st.text(max_size=80),
    st.none() | st.integers(-1, 70000),
    st.dictionaries(st.sampled_from([key.encode() for key in SAYS.properties()]), st.none() | st.binary(max_size=255)),
)
def test_any_record_is_an_offer_or_a_wire_error(
    name: str, port: int | None, properties: dict[bytes, bytes | None]
) -> None:
    with contextlib.suppress(WireError):
        assert isinstance(offer_of(name, port, ["10.0.0.2"] * 50, properties), Offer)


@pytest.mark.parametrize(
    ("host", "own", "interfaces", "addresses"),
    [
        ("0.0.0.0", [LOOPBACK, FIRST, SECOND], ["10.0.0.2", "192.168.0.3", "127.0.0.1"], ["10.0.0.2", "192.168.0.3"]),
        ("0.0.0.0", [LOOPBACK], ["127.0.0.1"], ["127.0.0.1"]),
        ("0.0.0.0", [], [], []),
        ("192.168.0.3", [LOOPBACK, FIRST, SECOND], ["192.168.0.3"], ["192.168.0.3"]),
        ("192.168.0.3", [LOOPBACK, FIRST], [], []),
        ("127.0.0.5", [LOOPBACK, FIRST], ["127.0.0.1"], ["127.0.0.5"]),
    ],
)
def test_addresses_to_announce(
    host: str, own: list[IPv4Interface], interfaces: list[str], addresses: list[str]
) -> None:
    assert addresses_to_announce(host, own) == (interfaces, addresses)


async def discovered(browser: Browser, good: Callable[[tuple[Offer, ...]], bool]) -> tuple[Offer, ...]:
    """Return the offers as soon as `good` accepts them."""
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + 15.0
    while not good(offers := await browser.offers()):
        assert loop.time() < deadline_s, offers
        await within(0.5, browser.changed.wait())
        browser.changed.clear()
    return offers


async def test_two_masters_of_one_cell_are_discovered_and_withdrawn() -> None:
    ours = f"cell {socket.gethostname()} {id(SAYS)}"

    def mine(offers: tuple[Offer, ...]) -> list[int]:
        return sorted(offer.port for offer in offers if offer.says.cell == ours)

    says = Announcement(ours, "ab" * 32, 3)
    announcing = [asyncio.create_task(Announcer(lambda: says, "127.0.0.1", port).run()) for port in (1001, 1002)]
    try:
        async with Browser() as browser:
            offers = await discovered(browser, lambda offers: mine(offers) == [1001, 1002])
            assert len({offer.name for offer in offers}) == len(offers)
            first = announcing.pop(0)
            first.cancel()
            await discovered(browser, lambda offers: mine(offers) == [1002])
            await asyncio.gather(first, return_exceptions=True)
    finally:
        for task in announcing:
            task.cancel()
        await asyncio.gather(*announcing, return_exceptions=True)


async def test_a_change_of_the_cell_is_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discovery, "POLL_S", 1.5)
    ours = f"changing {socket.gethostname()} {id(SAYS)}"
    versions = ["11" * 32]
    announcer = Announcer(lambda: Announcement(ours, versions[0], 3), "127.0.0.1", 1003)
    task = asyncio.create_task(announcer.run())

    def announces(sha256: str) -> Callable[[tuple[Offer, ...]], bool]:
        return lambda offers: any(offer.says == Announcement(ours, sha256, 3) for offer in offers)

    try:
        async with Browser() as browser:
            await discovered(browser, announces("11" * 8))
            versions[0] = "22" * 32
            await discovered(browser, announces("22" * 8))
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_addresses_are_polled_without_notifications_of_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> socket.socket:
        raise OSError("not in this sandbox")

    own = discovery.own_addresses()
    with monkeypatch.context() as patch:
        patch.setattr(socket, "socket", refused)
        changes = AddressChanges().__enter__()
    assert not await changes.within(0.0, own)
    monkeypatch.setattr(discovery, "own_addresses", lambda: (*own, FIRST))
    assert await changes.within(0.0, own)
