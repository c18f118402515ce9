# SPDX-License-Identifier: Apache-2.0
"""Discovery by multicast DNS (`_cellwatch._tcp`): masters announce their address and their cell, units browse.

Anyone on the network can send an announcement. It is an address to try, and no proof of anything.

Addresses come and go (a cable, DHCP). A socket that joined multicast before an interface had its address never receives
on that interface. So both sides open new sockets whenever this machine's IPv4 addresses change.
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

# zeroconf warns of every packet that it cannot send while a cable is out; we reopen it then, and log that once.
logging.getLogger("zeroconf").setLevel(logging.ERROR)

SERVICE_TYPE = "_cellwatch._tcp.local."

TTL_S = 120
"""mDNS TTL: listeners drop records that are not refreshed within 120 s."""

MAX_OFFERS = 16
"""Limit of announcements kept: more masters than any network should have. A faulty peer may announce without end."""

MAX_ADDRESSES = 8
"""Limit of addresses kept for one master."""

MAX_INTERFACES = 16
"""Limit of interfaces; Linux allows one socket to join 20 groups (igmp_max_memberships)."""

MAX_TXT_BYTES = 200
"""Limit of one TXT value; with its name it must stay below 256 bytes."""

MAX_LABEL_BYTES = 63
"""Limit of the name under which a master is announced (a DNS label)."""

SHA_DIGITS = 16
"""Announced hexadecimal digits of a sha256: enough to distinguish hashes, never to prove identity."""

RESOLVE_S = 1.0
"""Timeout for resolving the address of an announced master."""

SETTLE_S = 0.3
"""Delay after an address change, since several addresses usually change together."""

POLL_S = 5.0
"""Period of checks for address changes that the kernel did not report, and for changes of the announcement."""

RTMGRP_IPV4_IFADDR = 0x10
"""rtnetlink multicast group: an IPv4 address was added or removed."""

INTERNAL = ("docker", "br-", "veth", "virbr", "lxc", "cni", "l4tbr")
"""Prefixes of interfaces to containers and virtual machines, and of a Jetson's USB console (same address on all)."""

ANYWHERE = ("0.0.0.0", "::")


@dataclass(frozen=True)
class Announcement:
    """Announcement of a master. `fingerprint` is a prefix of the certificate's sha256; it is empty without TLS."""

    cell: str
    cell_sha256: str
    contract: int
    tls: bool = False
    fingerprint: str = ""
    minor: int = CONTRACT_MINOR

    def properties(self) -> dict[str, str]:
        """Return the TXT record, each value within its limit."""
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
    """A discovered master: its name, its announcement, and its addresses, each an alternative."""

    name: str
    says: Announcement
    addresses: tuple[str, ...]
    port: int

    @property
    def urls(self) -> tuple[str, ...]:
        """URLs under which the master says that it listens."""
        scheme = "https" if self.says.tls else "http"
        return tuple(f"{scheme}://{address}:{self.port}" for address in self.addresses)


def offer_of(name: str, port: int | None, addresses: Sequence[str], properties: Mapping[bytes, bytes | None]) -> Offer:
    """Build an offer from a multicast record; cut values to the lengths that we would send ourselves.

    Raises:
        WireError: the record is not a valid announcement.
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
    # Masters of contract 5.0 announced no minor.
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
    """Cut `text` to `max_bytes` of UTF-8, and replace characters that are not printable by `?`."""
    printable = "".join(letter if letter.isprintable() else "?" for letter in text)
    return printable.encode()[:max_bytes].decode("utf-8", "ignore")


def own_addresses() -> tuple[IPv4Interface, ...]:
    """Return this machine's IPv4 addresses with their networks, sorted, without interfaces to guests (`INTERNAL`)."""
    adapters = [adapter for adapter in ifaddr.get_adapters() if not adapter.nice_name.startswith(INTERNAL)]
    ips = [ip for adapter in adapters for ip in adapter.ips if ip.is_IPv4]
    return tuple(sorted({IPv4Interface(f"{ip.ip}/{ip.network_prefix}") for ip in ips}))


def only_loopback(host: str) -> bool:
    """Return True if `host` is a loopback address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class AddressChanges:
    """Detect changes of this machine's addresses: from the kernel's notifications, or else by polling."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()
        self._netlink: socket.socket | None = None

    def __enter__(self) -> AddressChanges:
        kind = socket.SOCK_RAW | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
        try:
            self._netlink = socket.socket(socket.AF_NETLINK, kind, socket.NETLINK_ROUTE)
            self._netlink.bind((0, RTMGRP_IPV4_IFADDR))
        except OSError as error:
            logger.debug("no address notifications from the kernel, polling instead: %s", error)
            self.__exit__(None, None, None)
        else:
            asyncio.get_running_loop().add_reader(self._netlink.fileno(), self._on_netlink)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._netlink is not None:
            asyncio.get_running_loop().remove_reader(self._netlink.fileno())
            self._netlink.close()
            self._netlink = None

    async def within(self, timeout_s: float, own: Sequence[IPv4Interface]) -> bool:
        """Return True if the addresses change within `timeout_s`, or differ from `own`."""
        if await within(timeout_s, self._changed.wait()):
            await asyncio.sleep(SETTLE_S)
            self._changed.clear()
            return True
        return own_addresses() != own

    async def until_other_than(self, own: Sequence[IPv4Interface]) -> None:
        """Wait until the addresses change or differ from `own`."""
        while not await self.within(POLL_S, own):
            pass

    def _on_netlink(self) -> None:
        assert self._netlink is not None
        try:
            while self._netlink.recv(65536):
                pass
        except BlockingIOError:
            pass
        except OSError as error:
            # The socket's buffer overflowed: addresses changed.
            logger.debug("netlink: %s", error)
        self._changed.set()


class Announcer:
    """Announce the master until `run` is cancelled, then withdraw the announcement.

    Each name ends in a random number, so that two masters of one cell on one network have two announcements.
    """

    def __init__(self, says: Callable[[], Announcement], host: str, port: int) -> None:
        """Take the current announcement from `says`, which is polled since the cell may change.

        The master listens on `port` of the IP address `host`.
        """
        self._says = says
        self._host = host
        self._port = port
        number = secrets.token_hex(2)
        name = shortened(f"{says().cell} at {socket.gethostname()}".replace(".", "-"), MAX_LABEL_BYTES - 8)
        self._name = f"{name} {number}"

    async def run(self) -> None:
        """Announce until cancelled."""
        logged = ""
        with AddressChanges() as changes:
            while True:
                own, said = own_addresses(), self._says()
                interfaces, addresses = addresses_to_announce(self._host, own)
                try:
                    async with _multicast(interfaces) as mdns:
                        if mdns is not None:
                            info = self._info(self._name, said, addresses)
                            await (await mdns.async_register_service(info, allow_name_change=True))
                            self._name = info.name.removesuffix(f".{SERVICE_TYPE}")
                            success = f"announced as {self._name!r} at {', '.join(addresses)} port {self._port}"
                            logger.log(logging.INFO if success != logged else logging.DEBUG, "%s", success)
                            logged = success
                        await self._until_addresses_change(mdns, changes, own, said, addresses)
                except (OSError, ZeroconfError) as error:
                    trouble = f"the master cannot be announced: {str(error) or type(error).__name__}"
                    logger.log(logging.WARNING if trouble != logged else logging.DEBUG, "%s", trouble)
                    logged = trouble
                    await changes.within(POLL_S, own)

    async def _until_addresses_change(
        self,
        mdns: AsyncZeroconf | None,
        changes: AddressChanges,
        own: tuple[IPv4Interface, ...],
        said: Announcement,
        addresses: Sequence[str],
    ) -> None:
        """Update the announcement when the cell changes, until the addresses change."""
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


def addresses_to_announce(host: str, own: Sequence[IPv4Interface]) -> tuple[list[str], list[str]]:
    """Return the own addresses to announce on, and the addresses to announce, for a server that listens at `host`.

    Always announce on loopback too, since a unit may run on this machine. Announce the loopback address itself only
    when there is no other.
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
    """Browse for masters while the context lasts; some ten packets at first, then one in many minutes."""

    def __init__(self) -> None:
        self.changed = asyncio.Event()
        """Set when a master was announced or withdrawn."""
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
        """Resolve all announced masters, and return the resolved ones sorted by name."""
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
        for info, resolved in zip(infos, answered, strict=True):
            if resolved:
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
                        browser = AsyncServiceBrowser(mdns.zeroconf, SERVICE_TYPE, handlers=[self._on_service])
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

    def _on_service(self, zeroconf: Zeroconf, service_type: str, name: str, state_change: ServiceStateChange) -> None:
        if state_change is ServiceStateChange.Removed:
            self._names.pop(name, None)
        elif len(self._names) < MAX_OFFERS:
            self._names[name] = None
        self.changed.set()


@asynccontextmanager
async def _multicast(interfaces: Sequence[str]) -> AsyncIterator[AsyncZeroconf | None]:
    """Open multicast DNS on these own addresses; yield None when there are none."""
    if not interfaces:
        yield None
        return
    mdns = AsyncZeroconf(interfaces=list(interfaces[:MAX_INTERFACES]), ip_version=IPVersion.V4Only)
    try:
        yield mdns
    finally:
        await mdns.async_close()
