# SPDX-License-Identifier: Apache-2.0
"""Which of the masters that were heard of is ours, decided from what is configured, kept and heard; no network here.

    configured   master_url, first in any case
    last_master         the last master that answered
    announced    ... if it watches our cell and may be believed as much as the one before, and is the only such

A foreign cell's master is taken only by a unit that was never told and never had another.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Interface
from urllib.parse import urlsplit

from shared.discovery import SHA_DIGITS, Offer, shortened
from shared.messages import CONTRACT_MINOR, CONTRACT_VERSION


@dataclass(frozen=True)
class MasterAddress:
    """Where a master is, in the form of a URL, and how that is known."""

    url: str
    found_by: str


@dataclass(frozen=True)
class LastMaster:
    """The last master that took us in: where, which cell it watched, how it was found, and the master_url of then."""

    url: str
    cell: str
    found_by: str
    configured: str | None = None


@dataclass(frozen=True)
class MasterCriteria:
    """What the configuration says of the master. With `checked`, it is known by its certificate."""

    url: str | None = None
    cell: str | None = None
    checked: bool = False
    fingerprint: str | None = None


@dataclass(frozen=True)
class Candidate:
    """A master that was heard of; `url` is where it was reached, `objection` why it is not for us."""

    offer: Offer
    url: str | None = None
    objection: str | None = None

    def __str__(self) -> str:
        cell, where = self.offer.says.cell, self.url or self.offer.urls[0]
        why = f": {self.objection}" if self.objection else ""
        return f"{self.offer.name!r} (cell {cell}, {where}){why}"


def initial_address(criteria: MasterCriteria, last_master: LastMaster | None) -> MasterAddress | None:
    """Where to go before anything is heard; None when nobody knows."""
    if criteria.url is not None:
        return MasterAddress(criteria.url, "configured")
    if last_master is None or is_ruled_out(last_master, criteria):
        return None
    return MasterAddress(last_master.url, "as before")


def is_ruled_out(last_master: LastMaster, criteria: MasterCriteria) -> bool:
    """Whether the configuration has changed so that the master of before will not do."""
    if criteria.checked and not last_master.url.startswith("https://"):
        return True
    if criteria.url is not None and criteria.url != last_master.configured:
        return True
    return criteria.cell is not None and last_master.cell != criteria.cell


def objection(offer: Offer, criteria: MasterCriteria, last_master: LastMaster | None) -> str | None:
    """Why this master is not for us, or None; what it says of itself is only ever held against it."""
    says = offer.says
    if says.contract != CONTRACT_VERSION or says.minor < CONTRACT_MINOR:
        older = "this unit" if says.contract > CONTRACT_VERSION else "the master"
        theirs, ours = f"{says.contract}.{says.minor}", f"{CONTRACT_VERSION}.{CONTRACT_MINOR}"
        return f"it speaks contract {theirs}, this unit {ours}; update {older} first"
    if criteria.checked and not says.tls:
        return "it does not speak TLS, and its certificate is to be checked"
    if criteria.fingerprint is not None and says.fingerprint != criteria.fingerprint[:SHA_DIGITS]:
        return "its certificate is not that of master_fingerprint"
    if last_master is not None and last_master.url.startswith("https://") and not says.tls:
        return "it does not speak TLS, as the master before did"
    if criteria.cell is not None:
        return None if says.cell == shortened(criteria.cell) else f"it does not watch cell {criteria.cell}"
    if last_master is not None:
        same = says.cell == shortened(last_master.cell)
        return None if same else f"it does not watch cell {last_master.cell}, as the master before"
    return "master_url names another" if criteria.url is not None else None


def choose(candidates: Sequence[Candidate], cells: Collection[str] = ()) -> tuple[Candidate | None, str]:
    """The one to take, if it is the only one that was reached and will do; and what was found, in words.

    `cells` are those whose masters would have done until now: where there were several, the last one that is left is
    no better than the others were.
    """
    if not candidates:
        return None, "no master is announced on this network"
    fit = [candidate for candidate in candidates if candidate.objection is None and candidate.url is not None]
    if len(fit) == 1 and set(cells) - {fit[0].offer.says.cell}:
        there = ", ".join(sorted({*cells, fit[0].offer.says.cell}))
        return None, f"masters of several cells were here ({there}), choose one by cell or master_url: {fit[0]}"
    if len(fit) == 1:
        return fit[0], f"announced as {fit[0].offer.name!r}"
    if fit:
        return None, f"{len(fit)} masters would do, choose one by cell or master_url: {'; '.join(map(str, fit))}"
    return None, f"none of the announced masters will do: {'; '.join(map(str, candidates))}"


def in_order(urls: Sequence[str], own: Sequence[IPv4Interface]) -> list[str]:
    """A master's URLs, the likeliest first: in one of our own networks, then beyond, then at an address of our own.

    The same private address may be many machines' own, so it is this machine only where nothing else answers.
    """

    def rank(url: str) -> int:
        address = IPv4Address(urlsplit(url).hostname or "0.0.0.0")
        if any(address == interface.ip for interface in own):
            return 2
        return 0 if any(address in interface.network for interface in own) else 1

    return sorted(urls, key=rank)
