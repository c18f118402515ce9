# SPDX-License-Identifier: Apache-2.0
"""Misbehaving peers of a master, each kind with addresses of its own, until they are stopped."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np

from shared.messages import MAX_VOXELS, UpdateRequest, Versions
from shared.wire import MEDIA_TYPE, encode_update, keys_to_bytes

SLOW_HEADS, SLOW_BODIES, LARGE, GARBAGE, FLOODS = 100, 100, 4, 4, 8
PER_ADDRESS = 20
DRIP_S = 0.1
PAUSE_S = 0.01
"""Time between two connections of one peer. Together the peers make some 1,200 requests a second."""

HELD_BY_ONE = 80
"""Connections of one address, above the limit."""

Peer = Callable[["BadPeers", str], Awaitable[None]]


@dataclass
class BadPeers:
    """A context in which the peers run. `seen` counts their actions and the results."""

    port: int
    token: str
    others_id: int
    seen: Counter[str] = field(default_factory=Counter)
    _tasks: list[asyncio.Task[None]] = field(default_factory=list)

    async def __aenter__(self) -> BadPeers:
        for number in range(SLOW_HEADS):
            self._begin(slow_head, f"127.0.101.{1 + number // PER_ADDRESS}")
        for number in range(SLOW_BODIES):
            self._begin(slow_body, f"127.0.102.{1 + number // PER_ADDRESS}")
        for kind, count, network in ((large, LARGE, 103), (garbage, GARBAGE, 104), (flood, FLOODS, 105)):
            for number in range(count):
                self._begin(kind, f"127.0.{network}.{1 + number}")
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self._tasks:
            task.cancel()
        for outcome in await asyncio.gather(*self._tasks, return_exceptions=True):
            assert isinstance(outcome, asyncio.CancelledError), outcome

    async def connect(self, ip: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection("127.0.0.1", self.port, local_addr=(ip, 0))

    def head(self, length: int) -> bytes:
        return (
            f"POST /update HTTP/1.1\r\nHost: master\r\nAuthorization: Bearer {self.token}\r\n"
            f"Content-Type: {MEDIA_TYPE}\r\nContent-Length: {length}\r\n\r\n"
        ).encode()

    def _begin(self, peer: Peer, ip: str) -> None:
        self._tasks.append(asyncio.ensure_future(self._again_and_again(peer, ip)))

    async def _again_and_again(self, peer: Peer, ip: str) -> None:
        while True:
            # The peer reconnects after any answer of the master.
            with suppress(OSError, asyncio.IncompleteReadError):
                await peer(self, ip)
            self.seen[peer.__name__] += 1
            await asyncio.sleep(PAUSE_S)


async def slow_head(peers: BadPeers, ip: str) -> None:
    reader, writer = await peers.connect(ip)
    with closed(writer):
        writer.write(b"POST /update HTTP/1.1\r\n")
        while not reader.at_eof():
            writer.write(b"a: b\r\n")
            await writer.drain()
            await asyncio.sleep(DRIP_S)


async def slow_body(peers: BadPeers, ip: str) -> None:
    reader, writer = await peers.connect(ip)
    with closed(writer):
        writer.write(peers.head(2**20))
        while not reader.at_eof():
            writer.write(b"\0" * 100)
            await writer.drain()
            await asyncio.sleep(DRIP_S)


async def large(peers: BadPeers, ip: str) -> None:
    """Post the largest possible update with a valid token for a unit at another address."""
    keys = keys_to_bytes(np.arange(MAX_VOXELS, dtype=np.uint32))
    update = UpdateRequest(id=peers.others_id, session=0, sequence=2**40, sent_at_ns=0, versions=Versions(), keys=keys)
    body = encode_update(update)
    reader, writer = await peers.connect(ip)
    with closed(writer):
        while True:
            writer.write(peers.head(len(body)) + body)
            await writer.drain()
            head = await reader.readuntil(b"\r\n\r\n")
            peers.seen[head.split(b" ", 2)[1].decode()] += 1
            await reader.readexactly(int(head.lower().split(b"content-length:")[1].split(b"\r\n")[0]))
            if b"connection: close" in head.lower():
                return
            await asyncio.sleep(DRIP_S / 3)


async def garbage(peers: BadPeers, ip: str) -> None:
    reader, writer = await peers.connect(ip)
    with closed(writer):
        writer.write(random.randbytes(random.randrange(1, 5000)))
        await reader.read()


async def flood(peers: BadPeers, ip: str) -> None:
    """Open as many connections as possible, and send nothing."""
    held = []
    try:
        for _ in range(HELD_BY_ONE):
            held.append(await peers.connect(ip))
            await asyncio.sleep(PAUSE_S)
        for reader, _ in held:
            await reader.read()
    finally:
        for _, writer in held:
            writer.transport.abort()


@contextmanager
def closed(writer: asyncio.StreamWriter) -> Iterator[None]:
    """Abort a connection at the end."""
    try:
        yield
    finally:
        writer.transport.abort()
