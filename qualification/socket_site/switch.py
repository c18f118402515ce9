# SPDX-License-Identifier: Apache-2.0
"""A network switch with sockets, each in a network namespace of its own: what is plugged in has its own address.

As in `faulting.network`, no namespace has a name, and the kernel takes all of it away with the last process.
"""

from __future__ import annotations

import subprocess

from qualification.networks import run

SWITCH = "switch0"

NETWORK = "10.79.0.{}"

MASTER_HOST = 1
"""Of the network: the switch's own address, at which the master listens."""


class Switch:
    """In this process's own namespace."""

    def __init__(self) -> None:
        """Raises ConfigError when the kernel has none."""
        # All ports hear all multicast: nobody here asks who wants which.
        run("ip", "link", "add", SWITCH, "type", "bridge", "mcast_snooping", "0")
        run("ip", "address", "add", f"{self.address}/24", "dev", SWITCH)
        run("ip", "link", "set", SWITCH, "up")

    @property
    def address(self) -> str:
        """The master's."""
        return NETWORK.format(MASTER_HOST)


class Socket:
    """Where one unit is plugged in."""

    def __init__(self, number: int, host: int) -> None:
        """The unit has address `host` of the network. Raises ConfigError when it cannot be made."""
        # `echo` tells that the namespace is there; `read` keeps it until we are gone.
        self._holder = subprocess.Popen(
            ("unshare", "--net", "sh", "-c", "echo; read line"), stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._holder.stdout is not None
        self._holder.stdout.readline()
        self.under = ("nsenter", f"--net=/proc/{self._holder.pid}/ns/net", "--")
        self._port = f"port{number}"
        self.address = ""
        run("ip", "link", "add", self._port, "type", "veth", "peer", "name", "eth0", "netns", str(self._holder.pid))
        run("ip", "link", "set", self._port, "master", SWITCH)
        run(*self.under, "ip", "link", "set", "lo", "up")
        self.plug(host)

    def plug(self, host: int) -> None:
        """Plug the cable in; the unit has this address from now on."""
        self.address = NETWORK.format(host)
        run(*self.under, "ip", "address", "flush", "dev", "eth0")
        run(*self.under, "ip", "address", "add", f"{self.address}/24", "dev", "eth0")
        run(*self.under, "ip", "link", "set", "eth0", "up")
        run("ip", "link", "set", self._port, "up")

    def pull(self) -> None:
        """Pull the cable out."""
        run("ip", "link", "set", self._port, "down")

    def close(self) -> None:
        """Take it away with its namespace."""
        self._holder.communicate()
