# SPDX-License-Identifier: Apache-2.0
"""A network switch with sockets, each in its own network namespace: each unit has its own address.

As in `faulting.network`, no namespace has a name, and the kernel removes all of them with the last process.
"""

from __future__ import annotations

import subprocess

from qualification.networks import run

SWITCH = "switch0"

NETWORK = "10.79.0.{}"

MASTER_HOST = 1
"""Host part of the switch's own address, at which the master listens."""


class Switch:
    """A bridge in the namespace of this process."""

    def __init__(self) -> None:
        """Create the bridge.

        Raises:
            ConfigError: the kernel has no bridges.
        """
        # All ports receive all multicast: nothing here subscribes by IGMP.
        run("ip", "link", "add", SWITCH, "type", "bridge", "mcast_snooping", "0")
        run("ip", "address", "add", f"{self.address}/24", "dev", SWITCH)
        run("ip", "link", "set", SWITCH, "up")

    @property
    def address(self) -> str:
        """Address of the master."""
        return NETWORK.format(MASTER_HOST)


class Socket:
    """A port of the switch for one unit."""

    def __init__(self, number: int, host: int) -> None:
        """Create the port and its namespace; the unit has address `host` of the network.

        Raises:
            ConfigError: the kernel refuses.
        """
        # `echo` reports that the namespace exists; `read` keeps it until this process ends.
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
        """Plug the cable in. The unit has this address from now on."""
        self.address = NETWORK.format(host)
        run(*self.under, "ip", "address", "flush", "dev", "eth0")
        run(*self.under, "ip", "address", "add", f"{self.address}/24", "dev", "eth0")
        run(*self.under, "ip", "link", "set", "eth0", "up")
        run("ip", "link", "set", self._port, "up")

    def pull(self) -> None:
        """Pull the cable out."""
        run("ip", "link", "set", self._port, "down")

    def close(self) -> None:
        """Remove the port and its namespace."""
        self._holder.communicate()
