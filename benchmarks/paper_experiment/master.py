# SPDX-License-Identifier: Apache-2.0
"""A real master, and the ways to bring voxels to it: by the units' own client, and by all units at once."""

from __future__ import annotations

import contextlib
import http.client
import os
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import msgpack
import numpy as np
from numpy.typing import NDArray

from benchmarks.load_generator.traffic import address_of, captured_head, with_head
from benchmarks.paper_experiment.contenders import Sight
from edge_unit.uplink.client import MasterClient
from shared.camera import Intrinsics
from shared.clock import NS_PER_MS, monotonic_ns, stage_ns
from shared.errors import MasterRefused, MasterUnreachable, UplinkError, WireError
from shared.messages import CONTRACT_MINOR, CONTRACT_VERSION, InitializeRequest, UpdateRequest, Versions
from shared.timebase import Exchange
from shared.transforms import Transform
from shared.wire import MEDIA_TYPE, decode_update_answer, encode_update
from simulation.fleet.processes import Processes
from simulation.fleet.running_master import RunningMaster, start_master

STALE_AFTER_S = 60.0
"""Stale time of the master in these measurements: a unit that waits for its turn must not go stale."""

TIMEOUT_S = 5.0
RECEIVE_BYTES = 65536


@dataclass(eq=False)
class Member:
    """One unit as its master knows it."""

    number: int
    serial: str
    client: MasterClient
    id: int = 0
    session: int = 0
    versions: Versions = field(default_factory=Versions)
    sequence: int = 0
    exchange: Exchange | None = None

    @classmethod
    def at(cls, url: str, token: str, number: int) -> Member:
        """Return unit `number`, which connects from an address of its own."""
        return cls(number, f"paper-{number}", MasterClient(url, lambda: token, address_of(number)))

    async def register(self, intrinsics: Intrinsics, T_world_camera: Transform) -> None:
        """Register the unit and the pose of its camera, and take over the master's current versions."""
        request = InitializeRequest(
            contract=CONTRACT_VERSION,
            contract_minor=CONTRACT_MINOR,
            serial=self.serial,
            intrinsics=intrinsics,
            sent_at_ns=monotonic_ns(),
        )
        answer = await self.client.initialize(request)
        pose = await self.client.put_pose(answer.id, T_world_camera, "configured")
        self.id, self.session, self.sequence = answer.id, answer.session, 0
        self.versions = answer.versions.model_copy(update={"pose": pose})

    def update(self, sight: Sight | None, captured_at_ns: int) -> UpdateRequest:
        """Return the unit's next update. None: it sees nothing unknown."""
        self.sequence += 1
        return UpdateRequest(
            id=self.id,
            session=self.session,
            sequence=self.sequence,
            captured_at_ns=captured_at_ns,
            sent_at_ns=monotonic_ns(),
            exchange=self.exchange,
            versions=self.versions,
            **({} if sight is None else {"keys": sight.keys, "seen": sight.seen, "health": sight.health}),
        )

    async def report(self, sight: Sight | None, captured_at_ns: int) -> None:
        """Post an update by the unit's client, encoding included."""
        update = self.update(sight, captured_at_ns)
        answer = await self.client.update(update)
        if answer.versions != self.versions:
            raise UplinkError(f"unit {self.number}: expected versions {self.versions}, got {answer.versions}")
        self.exchange = Exchange(update.sent_at_ns, answer.received_at_ns, answer.answered_at_ns, monotonic_ns())


class MapReader:
    """Reader of the merged map, as a robot reads it: over a connection that stays open."""

    def __init__(self, url: str, token: str) -> None:
        parts = urlsplit(url)
        self._http = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=TIMEOUT_S)
        self._headers = {"Authorization": f"Bearer {token}", "Accept": MEDIA_TYPE}

    def read(self) -> bytes:
        """Return the current map, not yet decoded."""
        self._http.request("GET", "/voxels?form=keys", headers=self._headers)
        answer = self._http.getresponse()
        body = answer.read()
        if answer.status != http.client.OK:
            raise MasterRefused(f"GET /voxels: {answer.status}: {body!r}", answer.status)
        return body

    def close(self) -> None:
        """Close the connection. The next request reconnects."""
        self._http.close()


def keys_of(body: bytes) -> NDArray[np.uint32]:
    """Return the voxels' keys (N,) of a map."""
    return np.array(msgpack.unpackb(body)["voxels"], np.uint32)


class Rush:
    """Plain sockets by which several units report at the same moment, at almost no cost on their side."""

    def __init__(self, url: str, head: bytes, members: Sequence[Member]) -> None:
        parts = urlsplit(url)
        self._server = parts.hostname or "", parts.port or 80
        self._head, self._members = head, members
        self._sockets: list[socket.socket] = []

    def connect(self) -> None:
        """Connect anew, because the master closes a connection that is silent for some seconds."""
        self.close()
        for member in self._members:
            each = socket.create_connection(self._server, TIMEOUT_S, (address_of(member.number), 0))
            self._sockets.append(each)
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def run(self, sights: Sequence[Sight | None]) -> float:
        """Send all updates at once. Return the milliseconds until the last is answered."""
        chosen = list(zip(self._sockets, self._members, strict=True))[: len(sights)]
        requests = [
            with_head(self._head, encode_update(member.update(sight, monotonic_ns())))
            for (_, member), sight in zip(chosen, sights, strict=True)
        ]
        began_ns = stage_ns()
        for (each, _), request in zip(chosen, requests, strict=True):
            each.sendall(request)
        bodies = [_answer(each) for each, _ in chosen]
        spent_ms = (stage_ns() - began_ns) / NS_PER_MS
        for (_, member), body in zip(chosen, bodies, strict=True):
            if (versions := decode_update_answer(body).versions) != member.versions:
                raise UplinkError(f"unit {member.number}: expected versions {member.versions}, got {versions}")
        return spent_ms

    def close(self) -> None:
        """Close the connections."""
        while self._sockets:
            self._sockets.pop().close()


@dataclass(eq=False)
class Site:
    """A running master, and the HTTP head of an update to it."""

    master: RunningMaster
    head: bytes

    @property
    def url(self) -> str:
        """Return the URL of the master."""
        return self.master.url

    @property
    def unit_token(self) -> str:
        """Return the token of the master's units."""
        return self.master.unit_token

    def pin(self, cores: set[int]) -> None:
        """Restrict the master, with all its threads, to these cores."""
        for thread in Path(f"/proc/{self.master.pid}/task").iterdir():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(int(thread.name), cores)

    async def change_voxel_size(self, voxel_size_m: float) -> None:
        """Change the voxel size of all units. They must register again."""
        headers = self.master.as_operator
        changes: dict[str, Any] = {"voxel_size_m": voxel_size_m, "stale_after_s": STALE_AFTER_S}
        async with httpx.AsyncClient(base_url=self.url, headers=headers, trust_env=False) as client:
            answer = await client.put("/settings", json=changes)
        if answer.is_error:
            raise MasterRefused(f"PUT /settings: {answer.status_code}: {answer.text}", answer.status_code)


async def start(processes: Processes, folder: Path, cell: Path) -> Site:
    """Start a master of this cell on a free port.

    Raises:
        MasterUnreachable: the master ends, or does not start in time.
    """
    master = await start_master(processes, cell, folder / "state", "--log-level", "WARNING")
    return Site(master, await captured_head(master.url, master.unit_token))


def _answer(connection: socket.socket) -> bytes:
    """Return the body of an answer once it is complete."""
    received = b""
    while True:
        data = connection.recv(RECEIVE_BYTES)
        if not data:
            raise MasterUnreachable("the master closed the connection")
        received += data
        head, end, body = received.partition(b"\r\n\r\n")
        if not end:
            continue
        if not head.startswith(b"HTTP/1.1 200"):
            raise MasterRefused(f"POST /update: {received!r}", int(head.split(b" ", 2)[1]))
        lengths = [row for row in head.lower().split(b"\r\n") if row.startswith(b"content-length:")]
        if not lengths:
            raise WireError("POST /update: expected a length in the answer's head, got none")
        if len(body) >= int(lengths[0].partition(b":")[2]):
            return body
