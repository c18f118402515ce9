# SPDX-License-Identifier: Apache-2.0
"""The choice among masters that were heard of, without any network."""

from __future__ import annotations

from ipaddress import IPv4Interface

import pytest

from edge_unit.uplink.master_selection import (
    Candidate,
    Kept,
    Place,
    Wanted,
    choose,
    distrusted,
    first_place,
    in_order,
    objection,
)
from shared.discovery import Announcement, Offer
from shared.messages import CONTRACT_VERSION

URL = "http://10.0.0.2:8420"
PIN = "ab" * 32
KEPT = Kept("http://10.0.0.9:8420", "demo", "announced as 'demo at pc 1a2b'")


def offer(cell: str = "demo", tls: bool = False, fingerprint: str = "", contract: int = CONTRACT_VERSION) -> Offer:
    return Offer(f"{cell} at pc", Announcement(cell, "00" * 8, contract, tls, fingerprint), ("10.0.0.2",), 8420)


@pytest.mark.parametrize(
    ("wanted", "kept", "place"),
    [
        (Wanted(), None, None),
        (Wanted(), KEPT, Place(KEPT.url, "as before")),
        (Wanted(URL), KEPT, Place(URL, "configured")),
        (Wanted(cell="demo"), KEPT, Place(KEPT.url, "as before")),
        (Wanted(cell="other"), KEPT, None),
        (Wanted(checked=True), KEPT, None),
        (Wanted(checked=True), Kept("https://10.0.0.9:1", "demo", "x"), Place("https://10.0.0.9:1", "as before")),
    ],
)
def test_where_to_go_before_anything_is_heard(wanted: Wanted, kept: Kept | None, place: Place | None) -> None:
    assert first_place(wanted, kept) == place


def test_a_master_of_another_configuration_is_not_returned_to() -> None:
    assert distrusted(Kept(URL, "demo", "configured", URL), Wanted("http://10.0.0.7:8420"))
    assert not distrusted(Kept("http://10.0.0.5:8420", "demo", "announced", URL), Wanted(URL))
    assert not distrusted(Kept(URL, "demo", "configured", URL), Wanted())


@pytest.mark.parametrize(
    ("offered", "wanted", "kept", "words"),
    [
        (offer("any"), Wanted(), None, None),
        (offer("demo"), Wanted(), KEPT, None),
        (offer("any"), Wanted(), KEPT, "as the master before"),
        (offer("any"), Wanted(cell="any"), KEPT, None),
        (offer("any"), Wanted(cell="demo"), None, "does not watch cell demo"),
        (offer("any"), Wanted(URL), None, "master_url names another"),
        (offer("demo"), Wanted(URL), KEPT, None),
        (offer("demo"), Wanted(URL, cell="demo"), None, None),
        (offer(contract=CONTRACT_VERSION + 1), Wanted(), None, "contract"),
        (offer(), Wanted(checked=True), None, "does not speak TLS"),
        (offer(tls=True, fingerprint="ab" * 8), Wanted(checked=True, fingerprint=PIN), None, None),
        (offer(tls=True, fingerprint="cd" * 8), Wanted(checked=True, fingerprint=PIN), None, "master_fingerprint"),
        (offer(tls=True), Wanted(checked=True), None, None),
        (offer(), Wanted(), Kept("https://10.0.0.9:1", "demo", "x"), "does not speak TLS, as the master before"),
    ],
)
def test_what_speaks_against_a_master(offered: Offer, wanted: Wanted, kept: Kept | None, words: str | None) -> None:
    against = objection(offered, wanted, kept)
    if words is None:
        assert against is None
    else:
        assert against is not None
        assert words in against


def test_the_only_one_that_will_do_is_taken() -> None:
    good = Candidate(offer("demo"), URL)
    foreign = Candidate(offer("other"), None, "it does not watch cell demo")
    silent = Candidate(offer("demo"), None, "it does not answer within 1 s")
    assert choose([foreign, good, silent]) == (good, "announced as 'demo at pc'")


def test_of_several_none_is_taken_and_all_are_named() -> None:
    taken, words = choose([Candidate(offer("one"), URL), Candidate(offer("two"), "http://10.0.0.3:8420")])
    assert taken is None
    for part in (
        "2 masters",
        "cell one, http://10.0.0.2:8420",
        "cell two, http://10.0.0.3:8420",
        "by cell or master_url",
    ):
        assert part in words


def test_the_last_one_left_of_several_cells_is_not_taken() -> None:
    left = Candidate(offer("two"), URL)
    taken, words = choose([left], {"one", "two"})
    assert taken is None
    assert "masters of several cells were here (one, two)" in words
    assert choose([left], {"two"})[0] is left


def test_why_none_will_do_is_told() -> None:
    assert choose([]) == (None, "no master is announced on this network")
    taken, words = choose([Candidate(offer("other"), None, "it does not watch cell demo")])
    assert taken is None
    assert "'other at pc' (cell other, http://10.0.0.2:8420): it does not watch cell demo" in words


def test_addresses_in_our_networks_come_first_and_our_own_last() -> None:
    own = [IPv4Interface("127.0.0.1/8"), IPv4Interface("172.17.0.1/16"), IPv4Interface("192.168.0.20/24")]
    urls = [f"http://{address}:8420" for address in ("10.9.0.1", "172.17.0.1", "192.168.0.10")]
    assert in_order(urls, own) == [urls[2], urls[0], urls[1]]
    # The master on this very machine.
    assert in_order(["http://192.168.0.20:8420"], own) == ["http://192.168.0.20:8420"]
