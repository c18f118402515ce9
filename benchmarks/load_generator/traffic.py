# SPDX-License-Identifier: Apache-2.0
"""Updates of units that see walking people, in the very bytes of the unit's own client."""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass, field
from ipaddress import IPv4Address
from urllib.parse import urlsplit

import msgpack
import numpy as np
from numpy.typing import NDArray

from edge_unit.uplink.client import MasterClient
from shared.errors import InputError, MasterUnreachable
from shared.lattice import Lattice
from shared.messages import Health, SeenReport, UpdateRequest, Versions
from shared.timebase import Exchange
from shared.wire import encode_update, keys_to_bytes, pack_seen

FIRST_ADDRESS = IPv4Address("127.0.0.2")
"""Address of the first unit; 127.0.0.1 is the master's."""

WALK_RADIUS_M, WALK_M_PER_S = 0.75, 1.5
"""People walk in a circle in the middle of the cell."""

SLENDER = 3.5
"""A person's height in widths."""

VIEWS = 8
"""Number of cameras with a person before each. Further units share these views at other moments."""

CAMERA_RADIUS_M, CAMERA_ABOVE_M, CAMERA_HALF_ANGLE_RAD = 2.2, 1.2, math.radians(35.0)

AGE_NS = 20_000_000
"""Time from the capture of a frame to its update: exposure, transfer and filter."""

LENGTH = b"Content-Length: "


@dataclass(frozen=True, eq=False)
class View:
    """One camera's reports of a person who walks in a circle: keys, seen report and its bytes, by step."""

    keys: tuple[bytes, ...]
    seen: tuple[SeenReport, ...]
    seen_bytes: tuple[int, ...]


def view(number: int, voxels: int, lattice: Lattice, blocks: Lattice, rate_hz: float) -> View:
    """Return view `number` of VIEWS, one step per frame of `rate_hz`. The person always has `voxels` voxels."""
    steps = round(2.0 * math.pi * WALK_RADIUS_M / WALK_M_PER_S * rate_hz)
    middle_m = np.asarray(lattice.origin_m) + 0.5 * lattice.voxel_size_m * np.asarray(lattice.shape)
    turn = 2.0 * math.pi * number / VIEWS
    camera_m = middle_m + CAMERA_RADIUS_M * _towards(turn) + (0.0, 0.0, CAMERA_ABOVE_M)
    block_m = blocks.centres(np.stack(np.unravel_index(np.arange(blocks.cell_count), blocks.shape), axis=-1))
    rays, forward = block_m - camera_m, middle_m - camera_m
    along = rays @ forward / np.linalg.norm(forward)
    inside = along > math.cos(CAMERA_HALF_ANGLE_RAD) * np.linalg.norm(rays, axis=1)
    keys, seen = [], []
    for step in range(steps):
        person_m = middle_m + WALK_RADIUS_M * _towards(turn + 2.0 * math.pi * step / steps)
        found, width_m = _person(person_m, voxels, lattice)
        keys.append(keys_to_bytes(found))
        report = pack_seen(
            (inside & ~_behind(rays, person_m - camera_m, width_m)).reshape(blocks.shape), blocks.voxel_size_m
        )
        if report is None:
            raise InputError(f"seen: {blocks.cell_count} blocks do not fit into one report")
        seen.append(report)
    seen_bytes = [len(msgpack.packb({"seen": report.model_dump()})) - 1 for report in seen]
    return View(tuple(keys), tuple(seen), tuple(seen_bytes))


def _person(centre_m: NDArray[np.float64], voxels: int, lattice: Lattice) -> tuple[NDArray[np.uint32], float]:
    """Return the keys of the `voxels` voxels nearest to a person, ascending, and half the person's width."""
    centre = (centre_m - lattice.origin_m) / lattice.voxel_size_m
    width = (3.0 * voxels / (4.0 * math.pi * SLENDER)) ** (1.0 / 3.0)
    axes = np.array((width, width, SLENDER * width))
    low = np.maximum(np.floor(centre - axes - 2.0), 0).astype(int)
    high = np.minimum(np.ceil(centre + axes + 2.0), lattice.shape).astype(int)
    if (high - low).prod() < voxels:
        raise InputError(f"a person of {voxels} voxels does not fit into {lattice.shape}")
    indices = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 3)
    distance = (((indices + 0.5 - centre) / axes) ** 2).sum(axis=1)
    nearest = np.argpartition(distance, voxels - 1)[:voxels]
    return np.sort(lattice.keys(indices[nearest])), width * lattice.voxel_size_m


def _behind(rays: NDArray[np.float64], person: NDArray[np.float64], width_m: float) -> NDArray[np.bool_]:
    """Return a mask of the `rays` (N, 3) from a camera that end behind a `person`, seen from above."""
    flat, axis = rays[:, :2], person[:2] / np.linalg.norm(person[:2])
    beyond = flat @ axis > np.linalg.norm(person[:2])
    across = flat[:, 0] * axis[1] - flat[:, 1] * axis[0]
    return np.asarray(beyond & (np.abs(across) < width_m))


def _towards(angle_rad: float) -> NDArray[np.float64]:
    """Return a horizontal direction."""
    return np.array((math.cos(angle_rad), math.sin(angle_rad), 0.0))


def address_of(number: int) -> str:
    """Return the IP address of a unit on this machine."""
    return str(FIRST_ADDRESS + number)


@dataclass(eq=False)
class SimpleUnit:
    """A unit that consists only of its messages. Times are CLOCK_MONOTONIC, the same clock as the master's."""

    address: str
    view: View
    step: int
    head: bytes
    id: int = 0
    session: int = 0
    versions: Versions = field(default_factory=Versions)
    sequence: int = 0
    exchange: Exchange | None = None
    joints_until_ns: int = 0
    keys: bytes = b""
    _seen: SeenReport | None = None
    _sent_at_ns: int = 0

    def request(self, captured_at_ns: int, now_ns: int) -> tuple[bytes, int]:
        """Return the next update with its HTTP head, and the number of its bytes that are the seen report."""
        self.step = (self.step + 1) % len(self.view.keys)
        self.sequence += 1
        self.keys, self._sent_at_ns = self.view.keys[self.step], now_ns
        seen = self.view.seen[self.step]
        changed, self._seen = seen != self._seen, seen
        update = UpdateRequest(
            id=self.id,
            session=self.session,
            sequence=self.sequence,
            captured_at_ns=captured_at_ns,
            sent_at_ns=now_ns,
            exchange=self.exchange,
            versions=self.versions,
            keys=self.keys,
            seen=seen if changed else None,
            health=Health(
                valid_share=0.87 + 0.001 * (self.step % 7),
                agreeing_share=0.93,
                residual_share=0.01,
                static_share=0.5,
                process_ms=8.123,
                frame=self.sequence,
            ),
            joints_until_ns=self.joints_until_ns,
        )
        return with_head(self.head, encode_update(update)), self.view.seen_bytes[self.step] if changed else 0

    def take(self, body: bytes, now_ns: int) -> None:
        """Process the master's answer."""
        answer = msgpack.unpackb(body)
        self.exchange = Exchange(self._sent_at_ns, answer["received_at_ns"], answer["answered_at_ns"], now_ns)
        if joints := answer.get("joints"):
            self.joints_until_ns = joints[-1][0]


def with_head(head: bytes, body: bytes) -> bytes:
    """Return a whole request; `head` is the result of `captured_head`."""
    return head % len(body) + body


async def captured_head(url: str, token: str) -> bytes:
    """Return the HTTP head of an update as the unit's client sends it to `url`, with `%d` for the body's length."""
    heads: list[bytes] = []

    async def record(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        heads.append(await reader.readuntil(b"\r\n\r\n"))
        writer.close()
        await writer.wait_closed()

    async with await asyncio.start_server(record, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        async with MasterClient(f"http://127.0.0.1:{port}", lambda: token) as client:
            update = UpdateRequest(id=0, session=0, sequence=0, sent_at_ns=0, versions=Versions())
            with contextlib.suppress(MasterUnreachable):
                await client.update(update)
    (head,) = heads
    head = head.replace(f"127.0.0.1:{port}".encode(), urlsplit(url).netloc.encode()).replace(b"%", b"%%")
    before, length, after = head.partition(LENGTH)
    return before + length + b"%d" + after[after.index(b"\r\n") :]
