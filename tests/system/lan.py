# SPDX-License-Identifier: Apache-2.0
"""A private network: a switch, and hosts plugged into it, as namespaces that end with their last process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

HOLD = ("sh", "-c", "ip link set lo up && echo && read line")
"""Reports that the namespace exists, and keeps it until the test ends."""

GET = """
import json, sys, urllib.request
opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
print(opener.open(sys.argv[1], timeout=2).read().decode())
"""


def run(*command: str) -> None:
    """Run a command of the system. A failure shows its output."""
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, f"{' '.join(command)}: {ended.stderr}"


@dataclass
class Host:
    """A machine in the network, with one interface `lan0`, or none until it is plugged in."""

    pid: int
    under: tuple[str, ...]
    """Prefix of a command that runs on this host."""

    def add(self, address: str) -> None:
        """Add an address to the host, as DHCP would."""
        run(*self.under, "ip", "address", "add", f"{address}/24", "dev", "lan0")

    def drop(self, address: str) -> None:
        """Remove an address."""
        run(*self.under, "ip", "address", "del", f"{address}/24", "dev", "lan0")

    def get(self, url: str) -> Any:
        """Return the answer at `url`, or None if there is none."""
        command = [*self.under, sys.executable, "-c", GET, url]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        return json.loads(ended.stdout) if ended.returncode == 0 else None


@dataclass
class Lan:
    """A network. Leaving the context removes all of it."""

    holders: list[subprocess.Popen[str]] = field(default_factory=list)

    def __enter__(self) -> Lan:
        own_user = () if os.geteuid() == 0 else ("--user", "--map-root-user")
        self._switch = self._hold("unshare", *own_user, "--net")
        self._nsenter = ("nsenter", *(("--user", "--preserve-credentials") if own_user else ()))
        run(*self._in(self._switch), "ip", "link", "add", "switch", "type", "bridge")
        run(*self._in(self._switch), "ip", "link", "set", "switch", "up")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for holder in self.holders:
            holder.communicate()

    def host(self, address: str | None = None, plugged: bool = True) -> Host:
        """Add a machine."""
        holder = self._hold(*self._in(self._switch), "unshare", "--net")
        host = Host(holder.pid, self._in(holder))
        if plugged:
            self.plug(host)
        if address is not None:
            host.add(address)
        return host

    def plug(self, host: Host) -> None:
        """Plug in the host's cable."""
        port, switch = f"port{host.pid}", self._in(self._switch)
        run(*switch, "ip", "link", "add", port, "type", "veth", "peer", "name", "lan0", "netns", str(host.pid))
        run(*switch, "ip", "link", "set", port, "master", "switch", "up")
        run(*host.under, "ip", "link", "set", "lan0", "up")

    def _in(self, holder: subprocess.Popen[str]) -> tuple[str, ...]:
        return (*self._nsenter, "--target", str(holder.pid), "--net", "--")

    def _hold(self, *command: str) -> subprocess.Popen[str]:
        holder = subprocess.Popen((*command, *HOLD), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.holders.append(holder)
        assert holder.stdout is not None
        assert holder.stdout.readline() == "\n"
        return holder
