# SPDX-License-Identifier: Apache-2.0
"""The search for a master that is not known or does not answer; silent while the master answers.

An address is used only if a master is verified there: with `master_ca` or `master_fingerprint` by a TLS handshake with
the right certificate. A server that fails it receives no request.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import ssl
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from edge_unit.config import UnitConfig
from edge_unit.tls import tls_context
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
from shared.clock import NS_PER_S
from shared.discovery import MAX_OFFERS, Browser, Offer, own_addresses
from shared.files import StateFile
from shared.waiting import LOOP_CLOCK, Clock, wait_set, within

logger = logging.getLogger(__name__)

LOST_S = 2.0
"""Time without an answer after which other masters are searched; a restarted master is back sooner."""

LOOK_S = 2.0
"""Pause between two searches, unless a new master is announced."""

HEAR_S = 1.0
"""Time from the first announcement to the choice; others answer within a fifth of a second."""

HEAR_FIRST_S = 2.0
"""The same for a permanent choice among all cells: masters are queried again after one second, and then after five."""

REACH_S = 1.0
"""Timeout of a connection; a master on the own network needs a hundredth of it, a busy board a tenth."""

VAIN_S = 30.0
"""Pause before an address is tried again that did not answer."""

TELL_S = 10.0
"""Pause between two log lines about masters; anyone on the network could cause them."""

FILE_NAME = "master.json"


class MasterSearch:
    """The address of the master. The uplink reports whether it answers; `run` searches for another one if not."""

    def __init__(self, config: UnitConfig, clock: Clock = LOOP_CLOCK) -> None:
        """Read files, so construct it before the event loop runs.

        Raises:
            ConfigError: `master_ca` cannot be read or holds no certificate.
        """
        self._clock = clock
        self._wanted = wanted_of(config)
        self._source_address = config.source_address
        self._path = config.state_dir / FILE_NAME
        self._kept = kept_of(config)
        self._tls = config.tls() or tls_context()
        self._place = first_place(self._wanted, self._kept)
        self._found = asyncio.Event()
        self._lost = asyncio.Event()
        self._silent_since_ns: int | None = None
        self._answered_once = False
        self._vain: dict[str, int] = {}
        self._cells: set[str] = set()
        # The last log line, and its time.
        self._logged = "", clock.now_ns() - round(TELL_S * NS_PER_S)
        self.outcome = "no master is configured, and none was known before"
        """Result of the last search, in words."""
        if self._place is None:
            self._lost.set()

    @property
    def lost(self) -> bool:
        """True while the master is lost and the search runs."""
        return self._lost.is_set()

    async def place(self) -> Place:
        """Return the address to use now; waits until there is one."""
        while self._place is None:
            self._found.clear()
            await self._found.wait()
        return self._place

    def answered(self, url: str) -> None:
        """Note that the master at `url` answers."""
        if self._place is not None and self._place.url == url:
            self._silent_since_ns = None
            self._answered_once = True
            self._lost.clear()

    async def keep(self, url: str, cell: str) -> None:
        """Note that the master at `url` registered this unit and watches `cell`; a restarted unit returns to it."""
        if self._place is None or self._place.url != url:
            return
        kept = Kept(url, cell, self._place.found_by, self._wanted.url)
        before, self._kept = self._kept, kept
        if before is None or (before.url, before.cell, before.configured) != (kept.url, kept.cell, kept.configured):
            await asyncio.to_thread(save_kept, self._path, kept)

    def unanswered(self, now_ns: int) -> None:
        """Note that the master does not answer, or refuses this unit."""
        if self._silent_since_ns is None:
            self._silent_since_ns = now_ns
        elif now_ns - self._silent_since_ns >= LOST_S * NS_PER_S:
            self._lost.set()

    async def run(self) -> None:
        """Search whenever the master is lost, until cancelled."""
        while True:
            await self._lost.wait()
            began_ns = none_since_ns = self._clock.now_ns()
            async with Browser() as browser:
                while self.lost:
                    browser.changed.clear()
                    offers, now_ns = await browser.offers(), self._clock.now_ns()
                    if not offers:
                        none_since_ns = now_ns
                    hear_s = HEAR_FIRST_S if self._any_cell else HEAR_S
                    heard = now_ns - (none_since_ns if offers else began_ns) >= hear_s * NS_PER_S
                    await self._look(offers if heard else None)
                    if self.lost:
                        await wait_set(browser.changed, LOOK_S if heard else HEAR_S, self._clock)

    async def _look(self, offers: Sequence[Offer] | None) -> None:
        """Use another address if one is suitable; returns None if it is too early to choose among offers."""
        now_ns = self._clock.now_ns()
        self._vain = {url: at_ns for url, at_ns in self._vain.items() if now_ns - at_ns < VAIN_S * NS_PER_S}
        before = [first_place(self._wanted, None), first_place(Wanted(), self._kept)]
        for place in before:
            if place is not None and self._new(place.url) and not await self._reach(place.url):
                self._take(place)
                return
        if offers is None:
            return
        tried = [url for offer in offers for url in offer.urls if not self._new(url)]
        candidates = await judged(offers, self._wanted, self._kept, self._tls, self._source_address, tried)
        if self._any_cell and len(self._cells) < MAX_OFFERS:
            # A master that failed the check does not count; one that is only slow to answer does.
            ours = [one.offer for one in candidates if one.url is not None] if self._wanted.checked else offers
            self._cells |= {one.says.cell for one in ours if objection(one, self._wanted, self._kept) is None}
        chosen, self.outcome = choose(candidates, self._cells)
        if chosen is not None and chosen.url is not None:
            self._take(Place(chosen.url, self.outcome))
            return
        logged, logged_at_ns = self._logged
        if now_ns - logged_at_ns >= TELL_S * NS_PER_S and self.outcome != logged:
            logger.info("%s", self.outcome)
            self._logged = self.outcome, now_ns

    @property
    def _any_cell(self) -> bool:
        """True if nothing says which cell's master is the right one."""
        return self._kept is None and self._wanted.cell is None

    async def _reach(self, url: str) -> str | None:
        return await reach(url, self._tls, self._source_address)

    def _new(self, url: str) -> bool:
        """Return True unless the address is the present one, or failed a moment ago."""
        return url not in self._vain and (self._place is None or url != self._place.url)

    def _take(self, place: Place) -> None:
        if self._place is not None and not self._answered_once:
            self._vain[self._place.url] = self._clock.now_ns()
        self._place = place
        self._silent_since_ns = None
        self._answered_once = False
        self._lost.clear()
        self._found.set()


def wanted_of(config: UnitConfig) -> Wanted:
    """Return the part of the configuration about the master."""
    url = None if config.master_url is None else config.master_url.rstrip("/")
    return Wanted(url, config.cell, config.checks_master, config.master_fingerprint)


def kept_of(config: UnitConfig) -> Kept | None:
    """Return the master that registered this unit last, if the configuration still allows it."""
    kept = load_kept(config.state_dir / FILE_NAME)
    return None if kept is None or distrusted(kept, wanted_of(config)) else kept


async def judged(
    offers: Sequence[Offer],
    wanted: Wanted,
    kept: Kept | None,
    tls: ssl.SSLContext,
    source_address: str | None,
    passed_over: Sequence[str] = (),
) -> list[Candidate]:
    """Return each offer with the objection or the URL at which it answered; URLs in `passed_over` are not tried."""
    own = own_addresses()

    async def candidate(offer: Offer) -> Candidate:
        against = objection(offer, wanted, kept)
        if against is not None:
            return Candidate(offer, None, against)
        against = "it was tried in vain"
        for url in in_order([url for url in offer.urls if url not in passed_over], own):
            failure = await reach(url, tls, source_address)
            if failure is None:
                return Candidate(offer, url)
            against = failure
        return Candidate(offer, None, against)

    return list(await asyncio.gather(*map(candidate, offers)))


async def reach(url: str, tls: ssl.SSLContext, source_address: str | None) -> str | None:
    """Return the reason why no master is verified at `url`, or None if one is; sends no more than a handshake."""
    parts = urlsplit(url)
    local = None if source_address is None else (source_address, 0)

    async def connect() -> None:
        _, writer = await asyncio.open_connection(
            parts.hostname, parts.port, ssl=tls if parts.scheme == "https" else None, local_addr=local
        )
        writer.transport.abort()

    try:
        return None if await within(REACH_S, connect()) else f"it does not answer within {REACH_S:g} s"
    except OSError as error:
        return f"it cannot be reached: {str(error) or type(error).__name__}"


def load_kept(path: Path) -> Kept | None:
    """Return the master that answered last; None if there is none or the file is damaged."""
    return StateFile(path).load(_kept_of_document)


def save_kept(path: Path, kept: Kept) -> None:
    """Store a master; if the file cannot be written, a warning says so."""
    StateFile(path).save(dataclasses.asdict(kept))


def _kept_of_document(document: Any) -> Kept:
    configured = document["configured"]
    kept = Kept(
        str(document["url"]),
        str(document["cell"]),
        str(document["found_by"]),
        None if configured is None else str(configured),
    )
    parts = urlsplit(kept.url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.port is None:
        raise ValueError(f"expected http://host:port, got {kept.url[:80]!r}")
    return kept
