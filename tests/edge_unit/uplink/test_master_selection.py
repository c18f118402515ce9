# SPDX-License-Identifier: Apache-2.0
"""The choice among announced masters, without a network."""

from __future__ import annotations

from ipaddress import IPv4Interface

import pytest

from edge_unit.uplink.master_selection import (
    Candidate,
    LastMaster,
    MasterAddress,
    MasterCriteria,
    choose,
    in_order,
    initial_address,
    is_ruled_out,
    objection,
)
from shared.discovery import Announcement, Offer
from shared.messages import CONTRACT_VERSION

URL = "http://10.0.0.2:8420"
PIN = "ab" * 32
LAST_MASTER = LastMaster("http://10.0.0.9:8420", "demo", "announced as 'demo at pc 1a2b'")


def offer(cell: str = "demo", tls: bool = False, fingerprint: str = "", contract: int = CONTRACT_VERSION) -> Offer:
    return Offer(f"{cell} at pc", Announcement(cell, "00" * 8, contract, tls, fingerprint), ("10.0.0.2",), 8420)


@pytest.mark.parametrize(
    ("criteria", "last_master", "address"),
    [
        (MasterCriteria(), None, None),
        (MasterCriteria(), LAST_MASTER, MasterAddress(LAST_MASTER.url, "as before")),
        (MasterCriteria(URL), LAST_MASTER, MasterAddress(URL, "configured")),
        (MasterCriteria(cell="demo"), LAST_MASTER, MasterAddress(LAST_MASTER.url, "as before")),
        (MasterCriteria(cell="other"), LAST_MASTER, None),
        (MasterCriteria(checked=True), LAST_MASTER, None),
        (
            MasterCriteria(checked=True),
            LastMaster("https://10.0.0.9:1", "demo", "x"),
            MasterAddress("https://10.0.0.9:1", "as before"),
        ),
    ],
)
def test_the_initial_address(
    criteria: MasterCriteria, last_master: LastMaster | None, address: MasterAddress | None
) -> None:
    assert initial_address(criteria, last_master) == address


def test_a_master_of_another_configuration_is_ruled_out() -> None:
    assert is_ruled_out(LastMaster(URL, "demo", "configured", URL), MasterCriteria("http://10.0.0.7:8420"))
    assert not is_ruled_out(LastMaster("http://10.0.0.5:8420", "demo", "announced", URL), MasterCriteria(URL))
    assert not is_ruled_out(LastMaster(URL, "demo", "configured", URL), MasterCriteria())


@pytest.mark.parametrize(
    ("offered", "criteria", "last_master", "words"),
    [
        (offer("any"), MasterCriteria(), None, None),
        (offer("demo"), MasterCriteria(), LAST_MASTER, None),
        (offer("any"), MasterCriteria(), LAST_MASTER, "cell demo of the last master"),
        (offer("any"), MasterCriteria(cell="any"), LAST_MASTER, None),
        (offer("any"), MasterCriteria(cell="demo"), None, "does not watch cell demo"),
        (offer("any"), MasterCriteria(URL), None, "master_url names another"),
        (offer("demo"), MasterCriteria(URL), LAST_MASTER, None),
        (offer("demo"), MasterCriteria(URL, cell="demo"), None, None),
        (offer(contract=CONTRACT_VERSION + 1), MasterCriteria(), None, "contract"),
        (offer(), MasterCriteria(checked=True), None, "does not speak TLS"),
        (offer(tls=True, fingerprint="ab" * 8), MasterCriteria(checked=True, fingerprint=PIN), None, None),
        (
            offer(tls=True, fingerprint="cd" * 8),
            MasterCriteria(checked=True, fingerprint=PIN),
            None,
            "master_fingerprint",
        ),
        (offer(tls=True), MasterCriteria(checked=True), None, None),
        (
            offer(),
            MasterCriteria(),
            LastMaster("https://10.0.0.9:1", "demo", "x"),
            "does not speak TLS, but the last master did",
        ),
    ],
)
def test_objections_to_a_master(
    offered: Offer, criteria: MasterCriteria, last_master: LastMaster | None, words: str | None
) -> None:
    against = objection(offered, criteria, last_master)
    if words is None:
        assert against is None
    else:
        assert against is not None
        assert words in against


def test_the_only_suitable_master_is_chosen() -> None:
    good = Candidate(offer("demo"), URL)
    foreign = Candidate(offer("other"), None, "it does not watch cell demo")
    silent = Candidate(offer("demo"), None, "it does not answer within 1 s")
    assert choose([foreign, good, silent]) == (good, "announced as 'demo at pc'")


def test_several_suitable_masters_are_named_and_none_is_chosen() -> None:
    taken, words = choose([Candidate(offer("one"), URL), Candidate(offer("two"), "http://10.0.0.3:8420")])
    assert taken is None
    for part in (
        "2 masters",
        "cell one, http://10.0.0.2:8420",
        "cell two, http://10.0.0.3:8420",
        "by cell or master_url",
    ):
        assert part in words


def test_the_last_remaining_master_of_several_cells_is_not_chosen() -> None:
    left = Candidate(offer("two"), URL)
    taken, words = choose([left], {"one", "two"})
    assert taken is None
    assert "masters of several cells were announced (one, two)" in words
    assert choose([left], {"two"})[0] is left


def test_the_reasons_against_all_masters_are_reported() -> None:
    assert choose([]) == (None, "no master is announced on this network")
    taken, words = choose([Candidate(offer("other"), None, "it does not watch cell demo")])
    assert taken is None
    assert "'other at pc' (cell other, http://10.0.0.2:8420): it does not watch cell demo" in words


def test_local_networks_come_first_and_own_addresses_last() -> None:
    own = [IPv4Interface("127.0.0.1/8"), IPv4Interface("172.17.0.1/16"), IPv4Interface("192.168.0.20/24")]
    urls = [f"http://{address}:8420" for address in ("10.9.0.1", "172.17.0.1", "192.168.0.10")]
    assert in_order(urls, own) == [urls[2], urls[0], urls[1]]
    # The master runs on this machine.
    assert in_order(["http://192.168.0.20:8420"], own) == ["http://192.168.0.20:8420"]
