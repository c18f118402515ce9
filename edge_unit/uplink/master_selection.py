# SPDX-License-Identifier: Apache-2.0
"""The choice of the unit's master. It uses the configuration, the last master and the announcements, and no network.

    configured   `master_url`; always tried first
    last master  the master that registered this unit last
    announced    the only announced master that watches the unit's cell and is checked as strictly as the last one

A unit accepts a master of any cell only if no cell is configured and it never had a master before.
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
    """The URL of a master, and the way in which it was found."""

    url: str
    found_by: str


@dataclass(frozen=True)
class LastMaster:
    """The last master that registered this unit.

    Attributes:
        url: its URL.
        cell: the name of its cell.
        found_by: the way in which it was found.
        configured: `master_url` at that time.
    """

    url: str
    cell: str
    found_by: str
    configured: str | None = None


@dataclass(frozen=True)
class MasterCriteria:
    """The configuration's criteria for the master. With `checked`, its certificate must be valid."""

    url: str | None = None
    cell: str | None = None
    checked: bool = False
    fingerprint: str | None = None


@dataclass(frozen=True)
class Candidate:
    """An announced master: the `url` at which it was reached, or the `objection` to it."""

    offer: Offer
    url: str | None = None
    objection: str | None = None

    def __str__(self) -> str:
        cell, where = self.offer.says.cell, self.url or self.offer.urls[0]
        why = f": {self.objection}" if self.objection else ""
        return f"{self.offer.name!r} (cell {cell}, {where}){why}"


def initial_address(criteria: MasterCriteria, last_master: LastMaster | None) -> MasterAddress | None:
    """Return the address to use before any announcement, or None if none is known."""
    if criteria.url is not None:
        return MasterAddress(criteria.url, "configured")
    if last_master is None or is_ruled_out(last_master, criteria):
        return None
    return MasterAddress(last_master.url, "as before")


def is_ruled_out(last_master: LastMaster, criteria: MasterCriteria) -> bool:
    """Return True if the configuration has changed and no longer allows the last master."""
    if criteria.checked and not last_master.url.startswith("https://"):
        return True
    if criteria.url is not None and criteria.url != last_master.configured:
        return True
    return criteria.cell is not None and last_master.cell != criteria.cell


def objection(offer: Offer, criteria: MasterCriteria, last_master: LastMaster | None) -> str | None:
    """Return the reason why this master does not fit, or None.

    An announcement is not authenticated. It can only exclude a master, and never proves its identity.
    """
    says = offer.says
    if says.contract != CONTRACT_VERSION or says.minor < CONTRACT_MINOR:
        older = "this unit" if says.contract > CONTRACT_VERSION else "the master"
        theirs, ours = f"{says.contract}.{says.minor}", f"{CONTRACT_VERSION}.{CONTRACT_MINOR}"
        return f"it speaks contract {theirs}, this unit {ours}; update {older} first"
    if criteria.checked and not says.tls:
        return "it does not speak TLS, but its certificate must be checked"
    if criteria.fingerprint is not None and says.fingerprint != criteria.fingerprint[:SHA_DIGITS]:
        return "its certificate does not match master_fingerprint"
    if last_master is not None and last_master.url.startswith("https://") and not says.tls:
        return "it does not speak TLS, but the last master did"
    if criteria.cell is not None:
        return None if says.cell == shortened(criteria.cell) else f"it does not watch cell {criteria.cell}"
    if last_master is not None:
        same = says.cell == shortened(last_master.cell)
        return None if same else f"it does not watch cell {last_master.cell} of the last master"
    return "master_url names another master" if criteria.url is not None else None


def choose(candidates: Sequence[Candidate], cells: Collection[str] = ()) -> tuple[Candidate | None, str]:
    """Return the only suitable candidate that was reached, or None; and the result as a sentence.

    `cells` are the cells of all suitable masters until now. If there were several, the unit does not choose the last
    remaining one, because it was not preferable to the others.
    """
    if not candidates:
        return None, "no master is announced on this network"
    fit = [candidate for candidate in candidates if candidate.objection is None and candidate.url is not None]
    if len(fit) == 1 and set(cells) - {fit[0].offer.says.cell}:
        names = ", ".join(sorted({*cells, fit[0].offer.says.cell}))
        return None, f"masters of several cells were announced ({names}), choose one by cell or master_url: {fit[0]}"
    if len(fit) == 1:
        return fit[0], f"announced as {fit[0].offer.name!r}"
    if fit:
        return None, f"{len(fit)} masters are suitable, choose one by cell or master_url: {'; '.join(map(str, fit))}"
    return None, f"none of the announced masters is suitable: {'; '.join(map(str, candidates))}"


def in_order(urls: Sequence[str], own: Sequence[IPv4Interface]) -> list[str]:
    """Return a master's URLs, likeliest first: local networks, other networks, this machine's addresses.

    Many machines can have the same private address. So an address of this machine is tried last.
    """

    def rank(url: str) -> int:
        address = IPv4Address(urlsplit(url).hostname or "0.0.0.0")
        if any(address == interface.ip for interface in own):
            return 2
        return 0 if any(address in interface.network for interface in own) else 1

    return sorted(urls, key=rank)
