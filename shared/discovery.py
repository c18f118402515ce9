# SPDX-License-Identifier: Apache-2.0
"""How a master is found: it tells by multicast DNS (`_cellwatch._tcp`) where it listens, and which cell it watches.

Anyone on the network may tell such things. What is heard here is a place to try, and no reason to believe it.

Addresses come and go (a cable, DHCP); whoever listens for multicast on an interface that was not there yet stays deaf
for ever. So both sides begin anew whenever this machine's IPv4 addresses change.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from ipaddress import IPv4Interface, ip_address
from types import TracebackType

import ifaddr
from zeroconf import Error as ZeroconfError
from zeroconf import IPVersion, ServiceStateChange, Zeroconf
from zeroconf.asyncio import AsyncServiceBrowser, AsyncServiceInfo, AsyncZeroconf

from shared.errors import WireError
from shared.messages import CONTRACT_MINOR
from shared.waiting import within

logger = logging.getLogger(__name__)

# It warns of every packet that cannot be sent while a cable is out; we begin anew then, and say so once.
logging.getLogger("zeroconf").setLevel(logging.ERROR)

SERVICE_TYPE = "_cellwatch._tcp.local."

TTL_S = 120
"""What is not told again is forgotten after two minutes, by who listens all the while."""

MAX_OFFERS = 16
"""More masters than any network should have; somebody may announce without end."""

MAX_ADDRESSES = 8
"""Of one master."""

MAX_INTERFACES = 16
"""Linux joins 20 groups with one socket (igmp_max_memberships)."""

MAX_TXT_BYTES = 200
"""Of one value; with its name it must stay below 256."""

MAX_LABEL_BYTES = 63
"""Of the name that a master is announced under."""

SHA_DIGITS = 16
"""Of a sha256: enough to tell one from another, never to prove anything."""

RESOLVE_S = 1.0
"""For a master that was heard of to say where it is."""

SETTLE_S = 0.3
"""Addresses mostly change several at once."""

POLL_S = 5.0
"""Between looks at what the kernel may not have told, and at what is to be announced."""

RTMGRP_IPV4_IFADDR = 0x10
"""Of rtnetlink: an IPv4 address came or went."""

INTERNAL = ("docker", "br-", "veth", "virbr", "lxc", "cni", "l4tbr")
"""Interfaces to containers and virtual machines, and a Jetson's USB console, which has one address on all of them."""

ANYWHERE = ("0.0.0.0", "::")


@dataclass(frozen=True)
class Announcement:
    """What a master tells of itself. `fingerprint` is the certificate's sha256 or its beginning; empty without TLS."""

    cell: str
    cell_sha256: str
    contract: int
    tls: bool = False
    fingerprint: str = ""
    minor: int = CONTRACT_MINOR

    def properties(self) -> dict[str, str]:
        """As it travels, each value bounded."""
        return {
            "cell": shortened(self.cell),
            "sha256": self.cell_sha256[:SHA_DIGITS],
            "contract": str(self.contract),
            "minor": str(self.minor),
            "tls": "yes" if self.tls else "no",
            "fingerprint": self.fingerprint[:SHA_DIGITS],
        }


@dataclass(frozen=True)
class Offer:
    """A master that was heard of: its name, what it tells of itself, and its URLs, each another way to it."""

    name: str
    says: Announcement
    addresses: tuple[str, ...]
    port: int

    @property
    def urls(self) -> tuple[str, ...]:
        """Where it claims to be."""
        scheme = "https" if self.says.tls else "http"
        return tuple(f"{scheme}://{address}:{self.port}" for address in self.addresses)


def offer_of(name: str, port: int | None, addresses: Sequence[str], properties: Mapping[bytes, bytes | None]) -> Offer:
    """An offer from what came by multicast; nothing in it is longer than what we would send.

    Raises:
        WireError: it is no announcement of ours.
    """
    values = {
        key: (properties.get(key.encode()) or b"")[: MAX_TXT_BYTES + 1].decode("utf-8", "replace")
        for key in ("cell", "sha256", "contract", "minor", "tls", "fingerprint")
    }
    label = name.removesuffix(f".{SERVICE_TYPE}")
    if not port or not 0 < port < 65536 or not addresses:
        raise WireError(f"announcement {label!r:.80}: expected a port and an address")
    for key, text in (("name", label), *values.items()):
        if not text.isprintable() or len(text.encode()) > MAX_TXT_BYTES:
            raise WireError(f"announcement {label!r:.80}: {key}: expected {MAX_TXT_BYTES} printable bytes at most")
    # Masters of contract 5.0 told no minor.
    contract, minor = values["contract"], values["minor"] or "0"
    if not (_is_number(contract) and _is_number(minor)) or not values["cell"]:
        raise WireError(f"announcement {label!r:.80}: expected a cell and a contract version")
    says = Announcement(
        values["cell"],
        values["sha256"][:SHA_DIGITS].lower(),
        int(contract),
        values["tls"] == "yes",
        values["fingerprint"][:SHA_DIGITS].lower(),
        int(minor),
    )
    return Offer(label, says, tuple(addresses[:MAX_ADDRESSES]), port)


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 9


def shortened(text: str, max_bytes: int = MAX_TXT_BYTES) -> str:
    """`text` as it is announced: its beginning where it is long, and nothing that is not printable."""
    printable = "".join(letter if letter.isprintable() else "?" for letter in text)
    return printable.encode()[:max_bytes].decode("utf-8", "ignore")


def own_addresses() -> tuple[IPv4Interface, ...]:
    """This machine's IPv4 addresses with their networks, in order; not those that lead only to guests on it."""
    adapters = [adapter for adapter in ifaddr.get_adapters() if not adapter.nice_name.startswith(INTERNAL)]
    ips = [ip for adapter in adapters for ip in adapter.ips if ip.is_IPv4]
    return tuple(sorted({IPv4Interface(f"{ip.ip}/{ip.network_prefix}") for ip in ips}))


def only_loopback(host: str) -> bool:
    """Whether who listens at `host` hears nobody but this machine."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class AddressChanges:
    """Tells that this machine's addresses changed: as the kernel says it, or else by looking now and then."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()
        self._netlink: socket.socket | None = None

    def __enter__(self) -> AddressChanges:
        kind = socket.SOCK_RAW | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
        try:
            self._netlink = socket.socket(socket.AF_NETLINK, kind, socket.NETLINK_ROUTE)
            self._netlink.bind((0, RTMGRP_IPV4_IFADDR))
        except OSError as error:
            logger.debug("the kernel does not tell of addresses: %s", error)
            self.__exit__(None, None, None)
        else:
            asyncio.get_running_loop().add_reader(self._netlink.fileno(), self._heard)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._netlink is not None:
            asyncio.get_running_loop().remove_reader(self._netlink.fileno())
            self._netlink.close()
            self._netlink = None

    async def within(self, timeout_s: float, own: Sequence[IPv4Interface]) -> bool:
        """Whether they changed within `timeout_s`, or are others than `own`."""
        if await within(timeout_s, self._changed.wait()):
            await asyncio.sleep(SETTLE_S)
            self._changed.clear()
            return True
        return own_addresses() != own

    async def until_other_than(self, own: Sequence[IPv4Interface]) -> None:
        """Wait until they change, or are others than `own`."""
        while not await self.within(POLL_S, own):
            pass

    def _heard(self) -> None:
        assert self._netlink is not None
        try:
            while self._netlink.recv(65536):
                pass
        except BlockingIOError:
            pass
        except OSError as error:
            # More was told than the socket could keep, which tells enough.
            logger.debug("netlink: %s", error)
        self._changed.set()


class Announcer:
    """Tells where the master is, until `run` is cancelled; then it takes that back.

    Two masters of one cell on one network are two announcements: each name ends in a random number.
    """

    def __init__(self, says: Callable[[], Announcement], host: str, port: int) -> None:
        """`says` is asked now and then, since the cell may change; the master listens at the IP address `host`."""
        self._says = says
        self._host = host
        self._port = port
        number = secrets.token_hex(2)
        name = shortened(f"{says().cell} at {socket.gethostname()}".replace(".", "-"), MAX_LABEL_BYTES - 8)
        self._name = f"{name} {number}"

    async def run(self) -> None:
        """Announce for ever."""
        told = ""
        with AddressChanges() as changes:
            while True:
                own, said = own_addresses(), self._says()
                interfaces, addresses = places(self._host, own)
                try:
                    async with _multicast(interfaces) as mdns:
                        if mdns is not None:
                            info = self._info(self._name, said, addresses)
                            await (await mdns.async_register_service(info, allow_name_change=True))
                            self._name = info.name.removesuffix(f".{SERVICE_TYPE}")
                            where = f"announced as {self._name!r} at {', '.join(addresses)} port {self._port}"
                            logger.log(logging.INFO if where != told else logging.DEBUG, "%s", where)
                            told = where
                        await self._until_moved(mdns, changes, own, said, addresses)
                except (OSError, ZeroconfError) as error:
                    trouble = f"cannot be announced: {str(error) or type(error).__name__}"
                    logger.log(logging.WARNING if trouble != told else logging.DEBUG, "%s", trouble)
                    told = trouble
                    await changes.within(POLL_S, own)

    async def _until_moved(
        self,
        mdns: AsyncZeroconf | None,
        changes: AddressChanges,
        own: tuple[IPv4Interface, ...],
        said: Announcement,
        addresses: Sequence[str],
    ) -> None:
        """Tell what changes of the cell, until the addresses do."""
        while not await changes.within(POLL_S, own):
            now = self._says()
            if mdns is not None and now != said:
                await (await mdns.async_update_service(self._info(self._name, now, addresses)))
            said = now

    def _info(self, name: str, says: Announcement, addresses: Sequence[str]) -> AsyncServiceInfo:
        return AsyncServiceInfo(
            SERVICE_TYPE,
            f"{name}.{SERVICE_TYPE}",
            self._port,
            server=f"{name}.{SERVICE_TYPE}",
            properties=says.properties(),
            host_ttl=TTL_S,
            other_ttl=TTL_S,
            parsed_addresses=list(addresses),
        )


def places(host: str, own: Sequence[IPv4Interface]) -> tuple[list[str], list[str]]:
    """On which of our own addresses to announce who listens at `host`, and the addresses to be told.

    Loopback is told only where there is nothing else, but announced on in any case: a unit may be on this machine.
    """
    ips = [str(interface.ip) for interface in own]
    outside = [ip for ip in ips if not only_loopback(ip)][:MAX_ADDRESSES]
    inside = [ip for ip in ips if only_loopback(ip)][:1]
    if host in ANYWHERE:
        return [*outside, *inside], outside or inside
    if only_loopback(host):
        return inside, [host] if inside else []
    return ([host], [host]) if host in outside else ([], [])


class Browser:
    """Hears of masters, for as long as the context lasts; some ten packets at first, then one in many minutes."""

    def __init__(self) -> None:
        self.changed = asyncio.Event()
        """Somebody was heard of, or took it back."""
        self._names: dict[str, None] = {}
        self._mdns: AsyncZeroconf | None = None
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Browser:
        self._task = asyncio.create_task(self._listen())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._task is not None
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)

    async def offers(self) -> tuple[Offer, ...]:
        """All masters that were heard of and say where they are, by name."""
        mdns = self._mdns
        if mdns is None:
            return ()
        infos = [AsyncServiceInfo(SERVICE_TYPE, name) for name in self._names]
        try:
            answered = await asyncio.gather(*(info.async_request(mdns.zeroconf, RESOLVE_S * 1000) for info in infos))
        except (OSError, ZeroconfError) as error:
            logger.debug("announcements cannot be read: %s", error)
            return ()
        found = []
        for info, there in zip(infos, answered, strict=True):
            if there:
                try:
                    addresses = info.parsed_addresses(IPVersion.V4Only)
                    found.append(offer_of(info.name, info.port, addresses, info.properties))
                except WireError as error:
                    logger.debug("%s", error)
        return tuple(sorted(found, key=lambda offer: offer.name))

    async def _listen(self) -> None:
        with AddressChanges() as changes:
            while True:
                own = own_addresses()
                try:
                    async with _multicast([str(interface.ip) for interface in own]) as mdns:
                        if mdns is None:
                            await changes.until_other_than(own)
                            continue
                        self._mdns = mdns
                        browser = AsyncServiceBrowser(mdns.zeroconf, SERVICE_TYPE, handlers=[self._heard])
                        try:
                            await changes.until_other_than(own)
                        finally:
                            await browser.async_cancel()
                except (OSError, ZeroconfError) as error:
                    logger.debug("cannot listen for announcements: %s", str(error) or type(error).__name__)
                    await changes.within(POLL_S, own)
                finally:
                    self._mdns = None
                    self._names.clear()

    def _heard(self, zeroconf: Zeroconf, service_type: str, name: str, state_change: ServiceStateChange) -> None:
        if state_change is ServiceStateChange.Removed:
            self._names.pop(name, None)
        elif len(self._names) < MAX_OFFERS:
            self._names[name] = None
        self.changed.set()


@asynccontextmanager
async def _multicast(interfaces: Sequence[str]) -> AsyncIterator[AsyncZeroconf | None]:
    """Multicast DNS on these own addresses; None where there are none."""
    if not interfaces:
        yield None
        return
    mdns = AsyncZeroconf(interfaces=list(interfaces[:MAX_INTERFACES]), ip_version=IPVersion.V4Only)
    try:
        yield mdns
    finally:
        await mdns.async_close()
