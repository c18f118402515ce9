# SPDX-License-Identifier: Apache-2.0
"""Load for a master, from a process of its own: many units, one thread, plain sockets.

`python -m benchmarks.load_generator.load PLAN RESULT` executes the `Plan` in one file and writes the figures to another
(JSON).

With a rate, the sending times are fixed beforehand, and a round trip counts from that time, even if the update was
really sent later. So a master that stalls still gets the updates of that time. Without a rate each unit sends again as
soon as it has its answer.
"""

from __future__ import annotations

import argparse
import asyncio
import heapq
import http.client
import json
import random
import select
import socket
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgpack
import numpy as np
import psutil

from benchmarks.load_generator.traffic import AGE_NS, VIEWS, SimpleUnit, address_of, captured_head, view
from edge_unit.uplink.client import MasterClient
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, MasterRefused, MasterUnreachable
from shared.messages import CONTRACT_MINOR, CONTRACT_VERSION, InitializeRequest
from shared.settings import Settings
from shared.wire import MEDIA_TYPE

FRAME_RATE_HZ = 30.0
"""Frame rate of the cameras. It sets the distance that people walk between two updates."""

GRACE_S = 1.0
"""Time after the last sending time. An update that is not acknowledged by then is lost."""

RECEIVE_BYTES = 65536
TIMEOUT_S = 2.0


@dataclass(frozen=True)
class Plan:
    """Plan of one load.

    `rate_hz` is the rate of each unit; None: as fast as answers come. `pid` is the process of the server, whose CPU
    time is measured. `bare` says that the server is the bare route, not a master.
    """

    url: str
    token_file: str
    cell: str
    units: int
    voxels: int
    seconds: float
    warm_up_s: float
    rate_hz: float | None = None
    pid: int | None = None
    bare: bool = False


@dataclass
class Tally:
    """Counts: `sent` and `lost` hold all updates, the other fields those after the warm-up."""

    sent: int = 0
    lost: int = 0
    counted: int = 0
    bytes_out: int = 0
    bytes_in: int = 0
    bytes_seen: int = 0
    seen_reports: int = 0
    cpu_percent: float = 0.0
    trips_ms: list[float] = field(default_factory=list)
    trouble: str = ""


class Connection:
    """One unit's open connection: one update in flight, and the sending times of those that wait behind it."""

    def __init__(self, unit: SimpleUnit, server: tuple[str, int]) -> None:
        self.unit = unit
        self.waiting: deque[int] = deque()
        self.due_ns: int | None = None
        self.size_out = self.size_seen = 0
        self._server = server
        self._received = b""
        self.socket = self._connect()

    def send(self, captured_at_ns: int) -> None:
        """Send the next update."""
        self.due_ns = self.waiting.popleft()
        request, self.size_seen = self.unit.request(captured_at_ns, monotonic_ns())
        self.size_out = len(request)
        self.socket.sendall(request)

    def receive(self) -> tuple[int, int, bytes] | None:
        """Return status, total bytes and body of an answer once it is complete.

        Raises:
            ConnectionError: the other side closed the connection.
        """
        data = self.socket.recv(RECEIVE_BYTES)
        if not data:
            raise ConnectionResetError("the master closed the connection")
        self._received += data
        head, end, body = self._received.partition(b"\r\n\r\n")
        if not end:
            return None
        length = int(head.lower().split(b"content-length:")[1].split(b"\r\n")[0])
        if len(body) < length:
            return None
        size = len(self._received)
        self._received = b""
        return int(head.split(b" ", 2)[1]), size, body

    def again(self) -> None:
        """Reconnect. The update in flight is lost."""
        self.socket.close()
        self._received, self.due_ns = b"", None
        self.socket = self._connect()

    def _connect(self) -> socket.socket:
        connection = socket.create_connection(self._server, TIMEOUT_S, (self.unit.address, 0))
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection


class Generator:
    """Drives all connections from one thread."""

    def __init__(self, plan: Plan, units: list[SimpleUnit]) -> None:
        parts = urlsplit(plan.url)
        self._plan = plan
        self._connections = [Connection(unit, (parts.hostname or "", parts.port or 80)) for unit in units]
        self.tally = Tally()

    def run(self) -> Tally:
        """Send until the end, then wait for the updates in flight."""
        plan, tally = self._plan, self.tally
        begin_ns = monotonic_ns()
        self._count_from_ns = begin_ns + round(plan.warm_up_s * NS_PER_S)
        self._end_ns = self._count_from_ns + round(plan.seconds * NS_PER_S)
        due = self._moments(begin_ns)
        by_socket = {each.socket: each for each in self._connections}
        cpu_before_s: float | None = None
        while True:
            now_ns = monotonic_ns()
            if cpu_before_s is None and now_ns >= self._count_from_ns:
                cpu_before_s = self._cpu_s()
            while due and due[0][0] <= now_ns:
                due_ns, number = due[0]
                connection = self._connections[number]
                connection.waiting.append(due_ns)
                tally.sent += 1
                if connection.due_ns is None:
                    connection.send(due_ns - AGE_NS)
                if plan.rate_hz is not None and (next_ns := due_ns + round(NS_PER_S / plan.rate_hz)) < self._end_ns:
                    heapq.heapreplace(due, (next_ns, number))
                else:
                    heapq.heappop(due)
            busy = any(each.due_ns is not None for each in self._connections)
            if not (due or busy) or now_ns > self._end_ns + GRACE_S * NS_PER_S:
                break
            next_ns = due[0][0] if due else now_ns + NS_PER_S
            # Neither epoll nor asyncio can wait for less than a whole millisecond.
            readable, _, _ = select.select(by_socket, (), (), max(next_ns - monotonic_ns(), 0) / NS_PER_S)
            for one in readable:
                connection = by_socket[one]
                try:
                    self._receive(connection)
                except OSError as error:
                    tally.lost += 1
                    tally.trouble = str(error)
                    del by_socket[one]
                    connection.again()
                    by_socket[connection.socket] = connection
        if cpu_before_s is not None:
            tally.cpu_percent = 100.0 * NS_PER_S * (self._cpu_s() - cpu_before_s) / (now_ns - self._count_from_ns)
        tally.lost += sum(len(each.waiting) + (each.due_ns is not None) for each in self._connections)
        return tally

    def send_all(self) -> None:
        """Send one more update from each unit, so that all units are live."""
        for connection in self._connections:
            connection.waiting.clear()
            if connection.due_ns is not None:
                # A late answer to an update that counts as lost must not be taken for the answer to this one.
                connection.again()
            connection.waiting.append(monotonic_ns())
            connection.send(monotonic_ns() - AGE_NS)
            while (answer := connection.receive()) is None:
                continue
            if answer[0] != http.client.OK:
                raise MasterRefused(f"the master answered with status {answer[0]}: {answer[2]!r}", answer[0])
            connection.unit.take(answer[2], monotonic_ns())

    def close(self) -> None:
        """Close all connections."""
        for connection in self._connections:
            connection.socket.close()

    def _cpu_s(self) -> float:
        if self._plan.pid is None:
            return 0.0
        times = psutil.Process(self._plan.pid).cpu_times()
        return float(times.user + times.system)

    def _moments(self, begin_ns: int) -> list[tuple[int, int]]:
        """Return the time of each unit's first update. Cameras run freely, so it is a random moment of the period."""
        if self._plan.rate_hz is None:
            return [(begin_ns, number) for number in range(len(self._connections))]
        draw = random.Random(0)
        period_ns = NS_PER_S / self._plan.rate_hz
        due = [(begin_ns + round(draw.random() * period_ns), number) for number in range(len(self._connections))]
        heapq.heapify(due)
        return due

    def _receive(self, connection: Connection) -> None:
        answer = connection.receive()
        if answer is None:
            return
        now_ns = monotonic_ns()
        status, size, body = answer
        due_ns, connection.due_ns = connection.due_ns, None
        assert due_ns is not None
        if status == http.client.OK:
            connection.unit.take(body, now_ns)
            if self._count_from_ns <= due_ns < self._end_ns:
                self._count(connection, size, (now_ns - due_ns) / NS_PER_MS)
        else:
            self.tally.lost += 1
            self.tally.trouble = f"{status}: {body!r}"
        if self._plan.rate_hz is None and now_ns < self._end_ns:
            connection.waiting.append(now_ns)
            self.tally.sent += 1
        if connection.waiting:
            connection.send(connection.waiting[0] - AGE_NS)

    def _count(self, connection: Connection, size: int, trip_ms: float) -> None:
        tally = self.tally
        tally.counted += 1
        tally.bytes_out += connection.size_out
        tally.bytes_in += size
        tally.bytes_seen += connection.size_seen
        tally.seen_reports += connection.size_seen > 0
        tally.trips_ms.append(trip_ms)


async def registered(plan: Plan, token: str) -> list[SimpleUnit]:
    """Register the units, each with its own address and a pose."""
    cell, settings = Cell.load(Path(plan.cell)), Settings()
    lattice, blocks = cell.lattice(settings.voxel_size_m), cell.lattice(settings.seen_block_size_m)
    views = [view(n, plan.voxels, lattice, blocks, FRAME_RATE_HZ) for n in range(min(plan.units, VIEWS))]
    head = await captured_head(plan.url, token)
    units = []
    for number in range(plan.units):
        unit = SimpleUnit(address_of(number), views[number % VIEWS], 11 * number, head)
        units.append(unit)
        if not plan.bare:
            await register(unit, plan.url, token)
    return units


async def register(unit: SimpleUnit, url: str, token: str) -> None:
    """Register one unit with the master, with a pose of its camera.

    Raises:
        MasterRefused: the master takes no more units.
        UplinkError: the master does not answer.
    """
    async with MasterClient(url, lambda: token, unit.address) as client:
        answer = await client.initialize(
            InitializeRequest(
                contract=CONTRACT_VERSION,
                contract_minor=CONTRACT_MINOR,
                serial=f"load-{unit.address}",
                intrinsics=Intrinsics(848, 480, 430.0, 430.0, 424.0, 240.0),
                sent_at_ns=monotonic_ns(),
            )
        )
        pose = await client.put_pose(answer.id, np.eye(4), "configured")
    unit.id, unit.session = answer.id, answer.session
    unit.versions = answer.versions.model_copy(update={"pose": pose})


def map_is_right(plan: Plan, token: str, units: list[SimpleUnit]) -> str:
    """Compare `GET /voxels` with the last updates of the units. Return the difference in words, or an empty text."""
    parts = urlsplit(plan.url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=TIMEOUT_S)
    headers = {"Authorization": f"Bearer {token}", "Accept": MEDIA_TYPE}
    connection.request("GET", "/voxels?form=keys", headers=headers)
    answer = msgpack.unpackb(connection.getresponse().read())
    connection.close()
    keys, witnesses = np.unique(np.concatenate([np.frombuffer(unit.keys, "<u4") for unit in units]), return_counts=True)
    if answer["units_live"] != len(units):
        return f"expected {len(units)} live units, got {answer['units_live']}: {answer['reasons'][:3]}"
    if not answer["complete"]:
        return f"not complete: {answer['reasons'][:3]}"
    if answer["voxels"] != keys.tolist() or answer["witnesses"] != witnesses.tolist():
        return f"expected {len(keys)} voxels, got {len(answer['voxels'])} or others or with other witnesses"
    return ""


def carry_out(plan: Plan) -> dict[str, Any]:
    """Execute the plan and return the figures by name.

    Raises:
        CellwatchError: the master cannot be reached, or refuses the units.
    """
    token = Path(plan.token_file).read_text(encoding="ascii").strip()
    units = asyncio.run(registered(plan, token))
    try:
        with closing(Generator(plan, units)) as generator:
            tally = generator.run()
            wrong = ""
            if not plan.bare:
                generator.send_all()
                wrong = map_is_right(plan, token, units)
    except OSError as error:
        raise MasterUnreachable(f"{plan.url}: {error}") from error
    trips_ms = np.array(tally.trips_ms or [np.nan])
    counts = asdict(tally)
    del counts["trips_ms"]
    return counts | {
        "p50_ms": float(np.percentile(trips_ms, 50)),
        "p99_ms": float(np.percentile(trips_ms, 99)),
        "max_ms": float(trips_ms.max()),
        "map_wrong": wrong,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run once."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.load_generator.load")
    parser.add_argument("plan", type=Path)
    parser.add_argument("result", type=Path)
    options = parser.parse_args(arguments)
    try:
        options.result.write_text(json.dumps(carry_out(Plan(**json.loads(options.plan.read_text())))))
    except CellwatchError as error:
        print(f"load: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
