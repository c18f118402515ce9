# SPDX-License-Identifier: Apache-2.0
"""The choice among masters, by configuration, by the last master, and by announcements; without any network access.

    configured   master_url, always first
    kept         the last master that answered
    announced    the only master that watches this unit's cell and is checked as well as the one before

A unit registers at the master of an unknown cell only if it has no configured cell and never had another master.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Interface
from urllib.parse import urlsplit

from shared.discovery import SHA_DIGITS, Offer, shortened
from shared.messages import CONTRACT_MINOR, CONTRACT_VERSION


@dataclass(frozen=True)
class Place:
    """URL of a master, and its origin."""

    url: str
    found_by: str


@dataclass(frozen=True)
class Kept:
    """The last master that registered this unit: its URL, its cell, its origin, and the master_url at that time."""

    url: str
    cell: str
    found_by: str
    configured: str | None = None


@dataclass(frozen=True)
class Wanted:
    """The configuration about the master. With `checked`, the master is verified by its certificate."""

    url: str | None = None
    cell: str | None = None
    checked: bool = False
    fingerprint: str | None = None


@dataclass(frozen=True)
class Candidate:
    """A master that was announced; `url` is where it answered, `objection` the reason why it is not suitable."""

    offer: Offer
    url: str | None = None
    objection: str | None = None

    def __str__(self) -> str:
        cell, where = self.offer.says.cell, self.url or self.offer.urls[0]
        why = f": {self.objection}" if self.objection else ""
        return f"{self.offer.name!r} (cell {cell}, {where}){why}"


def first_place(wanted: Wanted, kept: Kept | None) -> Place | None:
    """Return the address to use before any announcement; None if there is none."""
    if wanted.url is not None:
        return Place(wanted.url, "configured")
    return None if kept is None or distrusted(kept, wanted) else Place(kept.url, "as before")


def distrusted(kept: Kept, wanted: Wanted) -> bool:
    """Return True if the configuration changed so that the last master is not suitable any more."""
    if wanted.checked and not kept.url.startswith("https://"):
        return True
    if wanted.url is not None and wanted.url != kept.configured:
        return True
    return wanted.cell is not None and kept.cell != wanted.cell


def objection(offer: Offer, wanted: Wanted, kept: Kept | None) -> str | None:
    """Return the reason why this master is not suitable, or None. An announcement can only speak against a master."""
    says = offer.says
    if says.contract != CONTRACT_VERSION or says.minor < CONTRACT_MINOR:
        older = "this unit" if says.contract > CONTRACT_VERSION else "the master"
        theirs, ours = f"{says.contract}.{says.minor}", f"{CONTRACT_VERSION}.{CONTRACT_MINOR}"
        return f"it speaks contract {theirs}, this unit {ours}; update {older} first"
    if wanted.checked and not says.tls:
        return "it does not speak TLS, and its certificate is to be checked"
    if wanted.fingerprint is not None and says.fingerprint != wanted.fingerprint[:SHA_DIGITS]:
        return "its certificate is not that of master_fingerprint"
    if kept is not None and kept.url.startswith("https://") and not says.tls:
        return "it does not speak TLS, as the master before did"
    if wanted.cell is not None:
        return None if says.cell == shortened(wanted.cell) else f"it does not watch cell {wanted.cell}"
    if kept is not None:
        return (
            None if says.cell == shortened(kept.cell) else f"it does not watch cell {kept.cell}, as the master before"
        )
    return "master_url names another" if wanted.url is not None else None


def choose(candidates: Sequence[Candidate], cells: Collection[str] = ()) -> tuple[Candidate | None, str]:
    """Return the only suitable master that answered, and the result of the search in words.

    `cells` are those whose masters were suitable until now: if there were several, the last one that is left is not
    chosen either.
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
    """Return a master's URLs, likeliest first: in an own network, then beyond, then at an address of this machine.

    Many machines may have the same private address, so it means this machine only if nothing else answers.
    """

    def rank(url: str) -> int:
        address = IPv4Address(urlsplit(url).hostname or "0.0.0.0")
        if any(address == interface.ip for interface in own):
            return 2
        return 0 if any(address in interface.network for interface in own) else 1

    return sorted(urls, key=rank)
