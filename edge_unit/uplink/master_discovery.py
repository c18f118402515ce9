# SPDX-License-Identifier: Apache-2.0
"""The search for the master. It runs while the master is not known or does not answer, and sends nothing otherwise.

The unit uses an address only after a connection to it succeeded. With `master_ca` or `master_fingerprint` this includes
a TLS handshake with the right certificate. A host that fails the handshake gets no request at all.
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
    LastMaster,
    MasterAddress,
    MasterCriteria,
    choose,
    in_order,
    initial_address,
    is_ruled_out,
    objection,
)
from shared.clock import NS_PER_S
from shared.discovery import MAX_OFFERS, Browser, Offer, own_addresses
from shared.files import StateFile
from shared.waiting import LOOP_CLOCK, Clock, wait_set, within

logger = logging.getLogger(__name__)

LOST_S = 2.0
"""Time without an answer after which the search starts. A restarted master is back sooner."""

SEARCH_INTERVAL_S = 2.0
"""Interval of the search, unless a new master is announced."""

COLLECT_S = 1.0
"""Time from the first announcement to the choice. Other masters answer within a fifth of a second."""

COLLECT_FIRST_S = 2.0
"""The same for a choice among the masters of all cells, which is permanent. The browser queries all masters again after
one second, and then after five."""

CONNECT_TIMEOUT_S = 1.0
"""Timeout of a connection attempt. A master on the local network takes a hundredth of it, a busy board a tenth."""

RETRY_AFTER_S = 30.0
"""Pause before an address that failed is tried again."""

LOG_INTERVAL_S = 10.0
"""Minimum time between log lines about announced masters, because any host on the network can cause such lines."""

FILE_NAME = "master.json"


class MasterSearch:
    """The master's address.

    The uplink reports with `answered` and `unanswered` if the master answers. If it does not, `run` searches for
    another address.
    """

    def __init__(self, config: UnitConfig, clock: Clock = LOOP_CLOCK) -> None:
        """Read files. Call it outside the event loop.

        Raises:
            ConfigError: `master_ca` cannot be read or holds no certificate.
        """
        self._clock = clock
        self._criteria = criteria_of(config)
        self._source_address = config.source_address
        self._path = config.state_dir / FILE_NAME
        self._last_master = last_master_of(config)
        self._tls = config.tls() or tls_context()
        self._address = initial_address(self._criteria, self._last_master)
        self._found = asyncio.Event()
        self._lost = asyncio.Event()
        self._silent_since_ns: int | None = None
        self._answered_once = False
        self._failed_at_ns: dict[str, int] = {}
        self._cells: set[str] = set()
        # The last log line, and its time.
        self._logged = "", clock.now_ns() - round(LOG_INTERVAL_S * NS_PER_S)
        self.outcome = "no master is configured, and no earlier master is known"
        """Result of the last search, as a sentence."""
        if self._address is None:
            self._lost.set()

    @property
    def lost(self) -> bool:
        """Return True while the search runs."""
        return self._lost.is_set()

    async def address(self) -> MasterAddress:
        """Return the address to use now. Wait while none is known."""
        while self._address is None:
            self._found.clear()
            await self._found.wait()
        return self._address

    def answered(self, url: str) -> None:
        """Note that the master at `url` answers, which ends the search."""
        if self._address is not None and self._address.url == url:
            self._silent_since_ns = None
            self._answered_once = True
            self._lost.clear()

    async def keep(self, url: str, cell: str) -> None:
        """Save the master at `url`, which registered the unit and watches `cell`, for reconnects and restarts."""
        if self._address is None or self._address.url != url:
            return
        before, after = self._last_master, LastMaster(url, cell, self._address.found_by, self._criteria.url)
        self._last_master = after
        if before is None or (before.url, before.cell, before.configured) != (after.url, after.cell, after.configured):
            await asyncio.to_thread(save_last_master, self._path, after)

    def unanswered(self, now_ns: int) -> None:
        """Note that the master does not answer or refuses this unit. After `LOST_S` the search starts."""
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
                    collect_s = COLLECT_FIRST_S if self._any_cell else COLLECT_S
                    collected = now_ns - (none_since_ns if offers else began_ns) >= collect_s * NS_PER_S
                    await self._search_once(offers if collected else None)
                    if self.lost:
                        await wait_set(browser.changed, SEARCH_INTERVAL_S if collected else COLLECT_S, self._clock)

    async def _search_once(self, offers: Sequence[Offer] | None) -> None:
        """Use another address, if one is suitable. `offers` is None while it is too early to choose among them."""
        now_ns = self._clock.now_ns()
        self._failed_at_ns = {
            url: at_ns for url, at_ns in self._failed_at_ns.items() if now_ns - at_ns < RETRY_AFTER_S * NS_PER_S
        }
        before = [initial_address(self._criteria, None), initial_address(MasterCriteria(), self._last_master)]
        for address in before:
            if address is not None and self._is_untried(address.url) and not await self._reach(address.url):
                self._take(address)
                return
        if offers is None:
            return
        tried = [url for offer in offers for url in offer.urls if not self._is_untried(url)]
        candidates = await check_offers(
            offers, self._criteria, self._last_master, self._tls, self._source_address, tried
        )
        if self._any_cell and len(self._cells) < MAX_OFFERS:
            # A master that fails the check of its certificate does not count. A master that answers slowly does.
            ours = [one.offer for one in candidates if one.url is not None] if self._criteria.checked else offers
            self._cells |= {one.says.cell for one in ours if objection(one, self._criteria, self._last_master) is None}
        chosen, self.outcome = choose(candidates, self._cells)
        if chosen is not None and chosen.url is not None:
            self._take(MasterAddress(chosen.url, self.outcome))
            return
        logged, logged_at_ns = self._logged
        if now_ns - logged_at_ns >= LOG_INTERVAL_S * NS_PER_S and self.outcome != logged:
            logger.info("%s", self.outcome)
            self._logged = self.outcome, now_ns

    @property
    def _any_cell(self) -> bool:
        """Return True if neither the configuration nor the last master determines the cell."""
        return self._last_master is None and self._criteria.cell is None

    async def _reach(self, url: str) -> str | None:
        return await reach(url, self._tls, self._source_address)

    def _is_untried(self, url: str) -> bool:
        """Return True if `url` is not the address in use, and did not fail within the last `RETRY_AFTER_S`."""
        return url not in self._failed_at_ns and (self._address is None or url != self._address.url)

    def _take(self, address: MasterAddress) -> None:
        if self._address is not None and not self._answered_once:
            self._failed_at_ns[self._address.url] = self._clock.now_ns()
        self._address = address
        self._silent_since_ns = None
        self._answered_once = False
        self._lost.clear()
        self._found.set()


def criteria_of(config: UnitConfig) -> MasterCriteria:
    """Return the configuration's criteria for the master."""
    url = None if config.master_url is None else config.master_url.rstrip("/")
    return MasterCriteria(url, config.cell, config.checks_master, config.master_fingerprint)


def last_master_of(config: UnitConfig) -> LastMaster | None:
    """Return the master that registered this unit last, or None if the configuration rules it out."""
    last_master = load_last_master(config.state_dir / FILE_NAME)
    return None if last_master is None or is_ruled_out(last_master, criteria_of(config)) else last_master


async def check_offers(
    offers: Sequence[Offer],
    criteria: MasterCriteria,
    last_master: LastMaster | None,
    tls: ssl.SSLContext,
    source_address: str | None,
    skipped: Sequence[str] = (),
) -> list[Candidate]:
    """Return each offer with the URL that was reached, or with an objection. URLs in `skipped` are not tried."""
    own = own_addresses()

    async def candidate(offer: Offer) -> Candidate:
        against = objection(offer, criteria, last_master)
        if against is not None:
            return Candidate(offer, None, against)
        against = "an earlier attempt failed"
        for url in in_order([url for url in offer.urls if url not in skipped], own):
            failure = await reach(url, tls, source_address)
            if failure is None:
                return Candidate(offer, url)
            against = failure
        return Candidate(offer, None, against)

    return list(await asyncio.gather(*map(candidate, offers)))


async def reach(url: str, tls: ssl.SSLContext, source_address: str | None) -> str | None:
    """Try to connect to `url`, and return the reason of a failure or None. Only a TLS handshake is sent."""
    parts = urlsplit(url)
    local = None if source_address is None else (source_address, 0)

    async def connect() -> None:
        _, writer = await asyncio.open_connection(
            parts.hostname, parts.port, ssl=tls if parts.scheme == "https" else None, local_addr=local
        )
        writer.transport.abort()

    try:
        return (
            None if await within(CONNECT_TIMEOUT_S, connect()) else f"it does not answer within {CONNECT_TIMEOUT_S:g} s"
        )
    except OSError as error:
        return f"it cannot be reached: {str(error) or type(error).__name__}"


def load_last_master(path: Path) -> LastMaster | None:
    """Return the saved master. Return None if the file is missing or damaged."""
    return StateFile(path).load(_last_master_of_document)


def save_last_master(path: Path, last_master: LastMaster) -> None:
    """Save a master. If the file cannot be written, log a warning."""
    StateFile(path).save(dataclasses.asdict(last_master))


def _last_master_of_document(document: Any) -> LastMaster:
    configured = document["configured"]
    last_master = LastMaster(
        str(document["url"]),
        str(document["cell"]),
        str(document["found_by"]),
        None if configured is None else str(configured),
    )
    parts = urlsplit(last_master.url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.port is None:
        raise ValueError(f"expected http://host:port, got {last_master.url[:80]!r}")
    return last_master
