# SPDX-License-Identifier: Apache-2.0
"""Bound the requests of each address, so that none takes the master away from the others."""

from __future__ import annotations

from typing import TypeVar

from shared.clock import NS_PER_S
from shared.errors import Refusal

REQUESTS_PER_S = 1000.0
"""Above the load of a controller that sends joints at 500 Hz and reads the map at 100 Hz beside a unit of 90 fps."""

REQUESTS_BURST = 2000
"""Two seconds of requests at once: the backlog after a network outage."""

BODY_BYTES_A_REQUEST = 2**15
"""This much of a body counts as one more request: the largest update, 1 MiB, passes 30 times a second."""

WRONG_TOKENS_PER_S = 1.0
WRONG_TOKENS_BURST = 20
"""A unit whose token was replaced tries four times a second; beyond the burst, one try a second is checked."""

TRUSTED_S = 60.0
"""Time for which an address with a valid token is not blocked by the wrong tokens of others at the same address."""

COMPLAINTS_PER_S = 1.0
COMPLAINTS_BURST = 20
"""Lines of the log about one address: enough to find the fault, too few to fill a disk."""

CONNECTIONS_PER_S = 250.0
CONNECTIONS_BURST = 500
"""Above the rate of a script that opens a connection for each joint sample at 125 Hz."""

CONNECTIONS_PER_ADDRESS = 64
"""A unit holds four, a browser six."""

CONNECTIONS_MAX = 512
"""Twice what 64 units hold, and half of the 1024 files that a process may open by default."""

STRANGERS_MAX = 256
"""Part of these for addresses without a recent valid token, so that a crowd of them never blocks a unit."""

ADDRESSES_MAX = 4096
"""Addresses in each table; beyond, the oldest is dropped, which only loosens its limit."""

IPV4_PREFIX = "::ffff:"
"""Prefix of IPv4 addresses on a dual-stack socket."""

Value = TypeVar("Value")


def plain_ip(address: str) -> str:
    """Return one form of an address, for both kinds of sockets."""
    return address.removeprefix(IPV4_PREFIX)


class RateLimit:
    """A token bucket for each address, stored as the time at which it will be full again."""

    def __init__(self, per_s: float, burst: int) -> None:
        self._cost_ns = round(NS_PER_S / per_s)
        self._window_ns = burst * self._cost_ns
        self._full_at_ns: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._full_at_ns)

    def wait_ns(self, ip: str, now_ns: int) -> int:
        """Return the time until `ip` may send one more request; 0 or less means now."""
        return self._full_at_ns.get(ip, 0) + self._cost_ns - now_ns - self._window_ns

    def spend(self, ip: str, now_ns: int, count: float = 1) -> None:
        """Count requests of `ip`, allowed or not."""
        full_at_ns = max(self._full_at_ns.get(ip, 0), now_ns) + round(count * self._cost_ns)
        _remember(self._full_at_ns, ip, full_at_ns)


class Limits:
    """All rates and connections of one master; every time is the master's clock."""

    def __init__(self) -> None:
        self.requests = RateLimit(REQUESTS_PER_S, REQUESTS_BURST)
        self.wrong_tokens = RateLimit(WRONG_TOKENS_PER_S, WRONG_TOKENS_BURST)
        self.new_connections = RateLimit(CONNECTIONS_PER_S, CONNECTIONS_BURST)
        self._complaints = RateLimit(COMPLAINTS_PER_S, COMPLAINTS_BURST)
        self._trusted_at_ns: dict[str, int] = {}
        self._open: dict[str, int] = {}
        self._open_count = 0
        self.turned_away = {"request": 0, "token": 0, "connection": 0}
        """Count of each refusal since the start."""

    def admit(self, ip: str, now_ns: int) -> None:
        """Count a request.

        Raises:
            Refusal: 429, there were too many.
        """
        wait_ns = self.requests.wait_ns(ip, now_ns)
        if wait_ns > 0:
            self.turned_away["request"] += 1
            raise _too_many(f"requests: expected at most {REQUESTS_PER_S:g} a second from {ip}, got more", wait_ns)
        self.requests.spend(ip, now_ns)

    def read(self, ip: str, body_bytes: int, now_ns: int) -> None:
        """Count the body of a request after it was read; the next request may be refused for it."""
        self.requests.spend(ip, now_ns, body_bytes / BODY_BYTES_A_REQUEST)

    def may_be_logged(self, ip: str, now_ns: int) -> bool:
        """Return True and count a line if the log has room for one more line about this address."""
        if self._complaints.wait_ns(ip, now_ns) > 0:
            return False
        self._complaints.spend(ip, now_ns)
        return True

    def may_show_token(self, ip: str, now_ns: int) -> None:
        """Check the limit before a token is compared.

        Raises:
            Refusal: 429, this address has shown too many wrong tokens and no valid one lately.
        """
        wait_ns = self.wrong_tokens.wait_ns(ip, now_ns)
        if wait_ns > 0 and not self._is_trusted(ip, now_ns):
            self.turned_away["token"] += 1
            raise _too_many(f"token: {ip} has shown too many wrong ones", wait_ns)

    def token_was_wrong(self, ip: str, now_ns: int) -> None:
        """Count a wrong token."""
        # No debt: a unit whose trusted time has ended is checked again within a second, not within minutes.
        if self.wrong_tokens.wait_ns(ip, now_ns) <= 0:
            self.wrong_tokens.spend(ip, now_ns)

    def token_was_right(self, ip: str, now_ns: int) -> None:
        """Trust this address for `TRUSTED_S`."""
        _remember(self._trusted_at_ns, ip, now_ns)

    def connect(self, ip: str, now_ns: int) -> bool:
        """Return True and count the connection until `disconnect` if this address may have one more."""
        open_here = self._open.get(ip, 0)
        open_max = CONNECTIONS_MAX if self._is_trusted(ip, now_ns) else STRANGERS_MAX
        if (
            open_here >= CONNECTIONS_PER_ADDRESS
            or self._open_count >= open_max
            or self.new_connections.wait_ns(ip, now_ns) > 0
        ):
            self.turned_away["connection"] += 1
            return False
        self.new_connections.spend(ip, now_ns)
        self._open[ip] = open_here + 1
        self._open_count += 1
        return True

    def disconnect(self, ip: str) -> None:
        """Count a closed connection of this address."""
        self._open_count -= 1
        if self._open[ip] == 1:
            del self._open[ip]
        else:
            self._open[ip] -= 1

    def _is_trusted(self, ip: str, now_ns: int) -> bool:
        return now_ns - self._trusted_at_ns.get(ip, -(10**18)) <= TRUSTED_S * NS_PER_S

    @property
    def connections(self) -> int:
        """Number of open connections."""
        return self._open_count


def _too_many(sentence: str, wait_ns: int) -> Refusal:
    seconds = -(-wait_ns // NS_PER_S)
    return Refusal(429, f"{sentence}; try again in {seconds} s", retry_after_s=seconds)


def _remember(table: dict[str, Value], ip: str, value: Value) -> None:
    if ip not in table and len(table) >= ADDRESSES_MAX:
        del table[next(iter(table))]
    table[ip] = value
