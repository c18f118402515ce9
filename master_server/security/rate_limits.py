# SPDX-License-Identifier: Apache-2.0
"""How much one address may ask for, so that none takes the master from the others."""

from __future__ import annotations

from typing import TypeVar

from shared.clock import NS_PER_S
from shared.errors import Refusal

REQUESTS_PER_S = 1000.0
"""A robot's controller that tells joints at 500 Hz and reads the map at 100 Hz beside a unit of 90 fps stays below."""

REQUESTS_BURST = 2000
"""Two seconds of them at once: what piled up while a network was away."""

BODY_BYTES_A_REQUEST = 2**15
"""So much of a body counts as one more request: the largest update, 1 MiB, passes 30 times a second."""

WRONG_TOKENS_PER_S = 1.0
WRONG_TOKENS_BURST = 20
"""A unit whose token was replaced tries four times a second; beyond the burst it is heard once a second."""

TRUSTED_S = 60.0
"""An address that showed a valid token is not shut out for another's guesses at the same address for so long."""

COMPLAINTS_PER_S = 1.0
COMPLAINTS_BURST = 20
"""Lines of the log about one address: enough to see what is wrong, too few to fill a disk."""

CONNECTIONS_PER_S = 250.0
CONNECTIONS_BURST = 500
"""A script that connects anew for joints at 125 Hz stays below."""

CONNECTIONS_PER_ADDRESS = 64
"""A unit holds four, a browser six."""

CONNECTIONS_MAX = 512
"""Twice what 64 units hold, and half of the 1024 files that a process may open by default."""

STRANGERS_MAX = 256
"""Of these, for addresses that have shown no valid token lately: a crowd of them shuts no unit out."""

ADDRESSES_MAX = 4096
"""Remembered; beyond, the one that came first is forgotten, which only loosens its limit."""

IPV4_PREFIX = "::ffff:"
"""IPv4 addresses look like this on a socket for both."""

Value = TypeVar("Value")


def plain_ip(address: str) -> str:
    """One name for one address, whichever kind of socket it came by."""
    return address.removeprefix(IPV4_PREFIX)


class RateLimit:
    """A token bucket for each address, kept as the one time at which it will be full again."""

    def __init__(self, per_s: float, burst: int) -> None:
        self._cost_ns = round(NS_PER_S / per_s)
        self._window_ns = burst * self._cost_ns
        self._full_at_ns: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._full_at_ns)

    def wait_ns(self, ip: str, now_ns: int) -> int:
        """How long until `ip` may ask for one more; 0 or less: now."""
        return self._full_at_ns.get(ip, 0) + self._cost_ns - now_ns - self._window_ns

    def spend(self, ip: str, now_ns: int, count: float = 1) -> None:
        """Count what `ip` has asked for, allowed or not."""
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
        """How many of each were, since the start."""

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
        """Count a body that was read; the request after it may be refused for it."""
        self.requests.spend(ip, now_ns, body_bytes / BODY_BYTES_A_REQUEST)

    def may_be_logged(self, ip: str, now_ns: int) -> bool:
        """Whether the log has room for one more line about this address; if so it is counted."""
        if self._complaints.wait_ns(ip, now_ns) > 0:
            return False
        self._complaints.spend(ip, now_ns)
        return True

    def may_show_token(self, ip: str, now_ns: int) -> None:
        """Before a token is looked at.

        Raises:
            Refusal: 429, this address has shown too many wrong ones and no right one lately.
        """
        wait_ns = self.wrong_tokens.wait_ns(ip, now_ns)
        if wait_ns > 0 and not self._is_trusted(ip, now_ns):
            self.turned_away["token"] += 1
            raise _too_many(f"token: {ip} has shown too many wrong ones", wait_ns)

    def token_was_wrong(self, ip: str, now_ns: int) -> None:
        """Count a guess."""
        # No debt: a unit that was trusted for a minute and is out of it is heard within a second, not within minutes.
        if self.wrong_tokens.wait_ns(ip, now_ns) <= 0:
            self.wrong_tokens.spend(ip, now_ns)

    def token_was_right(self, ip: str, now_ns: int) -> None:
        """From now on this address is trusted for a while."""
        _remember(self._trusted_at_ns, ip, now_ns)

    def connect(self, ip: str, now_ns: int) -> bool:
        """Whether this address may have one more connection; if so it is counted until `disconnect`."""
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
        """One of its connections is closed."""
        self._open_count -= 1
        if self._open[ip] == 1:
            del self._open[ip]
        else:
            self._open[ip] -= 1

    def _is_trusted(self, ip: str, now_ns: int) -> bool:
        return now_ns - self._trusted_at_ns.get(ip, -(10**18)) <= TRUSTED_S * NS_PER_S

    @property
    def connections(self) -> int:
        """How many are open."""
        return self._open_count


def _too_many(sentence: str, wait_ns: int) -> Refusal:
    seconds = -(-wait_ns // NS_PER_S)
    return Refusal(429, f"{sentence}; try again in {seconds} s", retry_after_s=seconds)


def _remember(table: dict[str, Value], ip: str, value: Value) -> None:
    if ip not in table and len(table) >= ADDRESSES_MAX:
        del table[next(iter(table))]
    table[ip] = value
