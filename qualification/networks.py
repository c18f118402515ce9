# SPDX-License-Identifier: Apache-2.0
"""Networks that fail: private namespaces with a cable between them, and a proxy that delays, cuts and records.

Everything runs in unnamed namespaces, which the kernel removes with their last process, however it ends. The machine's
own interfaces and mounts are never changed.
"""

from __future__ import annotations

import asyncio
import os
import random
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import ConfigError
from simulation.fleet.processes import raise_when_stopped

MASTER_IP, UNIT_IP = "10.77.0.1", "10.77.0.2"
"""Addresses at the two ends of the cable."""

CHUNK_BYTES = 65536


NAMESPACES = (("unshare", "--net", "--mount"), ("unshare", "--user", "--map-root-user", "--net", "--mount"))
"""Commands for root, and for any user if the kernel allows it."""


def allowed(unshare: Sequence[str]) -> bool:
    """Return True if this command can make its namespaces here."""
    try:
        return not subprocess.run((*unshare, "true"), capture_output=True, check=False).returncode
    except FileNotFoundError:
        return False


def confine(module: str, arguments: Sequence[str], inside: bool) -> None:
    """Continue with a private network and private mounts; SIGTERM then raises KeyboardInterrupt.

    Unless this process is `inside` already, `python -m module --inside arguments` takes its place.

    Raises:
        ConfigError: the kernel does not allow it.
    """
    if inside:
        raise_when_stopped()
        run("ip", "link", "set", "lo", "up")
        return
    for unshare in NAMESPACES:
        if allowed(unshare):
            os.execvp(unshare[0], (*unshare, sys.executable, "-m", module, "--inside", *arguments))
    raise ConfigError("namespaces: expected to be root, or a kernel where anyone may make them (man 7 user_namespaces)")


def run(*command: str) -> None:
    """Run a command of the system.

    Raises:
        ConfigError: it failed, or is not installed.
    """
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except FileNotFoundError as error:
        raise ConfigError(f"{command[0]}: expected to be installed (packages iproute2, util-linux)") from error
    except subprocess.CalledProcessError as error:
        raise ConfigError(f"{' '.join(command)}: {error.stderr.strip()}") from error


class Cable:
    """Another network namespace, and a cable from there to here."""

    def __init__(self) -> None:
        """Make the cable. Raises ConfigError if that fails."""
        # `echo` reports that the namespace exists; `read` keeps it until this process ends.
        self._holder = subprocess.Popen(
            ("unshare", "--net", "sh", "-c", "echo; read line"), stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._holder.stdout is not None
        self._holder.stdout.readline()
        self.under = ("nsenter", f"--net=/proc/{self._holder.pid}/ns/net", "--")
        run("ip", "link", "add", "cut0", "type", "veth", "peer", "name", "cut1", "netns", str(self._holder.pid))
        run("ip", "address", "add", f"{MASTER_IP}/24", "dev", "cut0")
        run(*self.under, "ip", "address", "add", f"{UNIT_IP}/24", "dev", "cut1")
        run(*self.under, "ip", "link", "set", "cut1", "up")
        self.plug()

    def plug(self) -> None:
        """Plug the cable in."""
        run("ip", "link", "set", "cut0", "up")

    def pull(self) -> None:
        """Pull the cable out."""
        run("ip", "link", "set", "cut0", "down")

    def close(self) -> None:
        """Remove the cable with its namespace."""
        self._holder.communicate()


@dataclass
class Proxy:
    """Forwards TCP from a port of its own to the master, with the unit's own address as the source."""

    master_port: int
    unit_address: str
    delay_s: float = 0.0
    jitter_s: float = 0.0
    """Jitter of the unit's data. Answers are forwarded at once."""

    sent: list[bytes] = field(default_factory=list)
    """Whole requests of the unit, oldest first."""

    url: str = field(init=False, default="")
    _server: asyncio.Server = field(init=False)
    _writers: set[asyncio.StreamWriter] = field(init=False, default_factory=set)
    _tasks: set[asyncio.Task[None]] = field(init=False, default_factory=set)

    async def open(self) -> None:
        """Listen."""
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.url = f"http://127.0.0.1:{self._server.sockets[0].getsockname()[1]}"

    def cut(self) -> None:
        """Reset all open connections. New ones are accepted."""
        for writer in list(self._writers):
            writer.transport.abort()

    async def close(self) -> None:
        """Stop."""
        self._server.close()
        self.cut()
        await asyncio.gather(*self._tasks)
        await self._server.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        ends = {writer}
        waiting: asyncio.Queue[tuple[int, bytes]] = asyncio.Queue()
        try:
            answers, to_master = await asyncio.open_connection(
                "127.0.0.1", self.master_port, local_addr=(self.unit_address, 0)
            )
            ends.add(to_master)
            self._writers |= ends
            ways = self._take(reader, waiting), self._pass_on(waiting, to_master), self._back(answers, writer)
            tasks = [asyncio.create_task(way) for way in ways]
            # One end is closed, so the other is closed, too. The client reconnects.
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for way in tasks:
                way.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        except OSError:
            # The master is not running.
            pass
        finally:
            self._tasks.discard(task)
            self._writers -= ends
            for end in ends:
                end.transport.abort()

    async def _take(self, reader: asyncio.StreamReader, waiting: asyncio.Queue[tuple[int, bytes]]) -> None:
        """Read the unit's data, queue each piece with the time at which it is due, and record it request by request."""
        begun = b""
        while data := await reader.read(CHUNK_BYTES):
            late_s = max(self.delay_s + random.uniform(-self.jitter_s, self.jitter_s), 0.0)
            waiting.put_nowait((monotonic_ns() + round(late_s * NS_PER_S), data))
            begun = self._remember(begun + data)

    async def _pass_on(self, waiting: asyncio.Queue[tuple[int, bytes]], writer: asyncio.StreamWriter) -> None:
        """Forward the data to the master, in order."""
        while True:
            due_ns, data = await waiting.get()
            await asyncio.sleep(max(due_ns - monotonic_ns(), 0) / NS_PER_S)
            writer.write(data)
            await writer.drain()

    async def _back(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(CHUNK_BYTES):
            writer.write(data)
            await writer.drain()

    def _remember(self, data: bytes) -> bytes:
        """Record the complete requests, and return the rest."""
        while b"\r\n\r\n" in data:
            head, _, rest = data.partition(b"\r\n\r\n")
            length = next(
                (int(line[15:]) for line in head.split(b"\r\n") if line.lower().startswith(b"content-length:")), 0
            )
            if len(rest) < length:
                break
            self.sent.append(head + b"\r\n\r\n" + rest[:length])
            data = rest[length:]
        return data
