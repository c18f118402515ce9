# SPDX-License-Identifier: Apache-2.0
"""A master, a moving robot's controller and four units whose only input is a token, each in its own network."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import httpx
import numpy as np
import yaml

from edge_unit.config import ENVIRONMENT_PREFIX as UNIT_PREFIX
from edge_unit.sources.simulated import SimulatedSourceConfig
from qualification.fault_site.site import START_S, FaultError
from qualification.socket_site.switch import Socket, Switch
from shared.clock import NS_PER_S, monotonic_ns
from shared.transforms import Transform
from simulation.fleet.processes import Child, Processes
from simulation.fleet.running_master import start_master
from simulation.fleet.unit import MODULE as UNIT_MODULE
from simulation.world.handling import LEFT_ALONE, Handling
from simulation.world.world import DEMO_CELL

UNITS = 4

FIRST_HOST = 11
"""Host part of the first unit's address. A unit that is plugged in again gets one from `OTHER_HOST` on."""
OTHER_HOST = 101

PORT = 8420

TRACE = "trace.msgpack"

POLL_S = 0.02
"""Time between two requests to the master."""

Found = TypeVar("Found")


@dataclass(eq=False)
class PluggedUnit:
    """One unit. Hands reach its camera through the file `handling`. Its process began at `started_ns`."""

    number: int
    folder: Path
    socket: Socket
    source: SimulatedSourceConfig
    handling: Path
    child: Child
    started_ns: int

    @property
    def name(self) -> str:
        """Name for people."""
        return f"unit {self.number}"

    def handle(self, handling: Handling) -> int:
        """Do this to the unit's camera. Return the time, ns."""
        handling.write(self.handling)
        return monotonic_ns()

    def leave_alone(self) -> int:
        """Put the unit's camera back in its place. Return the time, ns."""
        return self.handle(LEFT_ALONE)


@dataclass(eq=False)
class PlugSite:
    """All processes and namespaces; `folder` holds configurations, tokens, state, records and logs."""

    folder: Path
    processes: Processes
    switch: Switch
    units: list[PluggedUnit] = field(init=False, default_factory=list)
    sockets: list[Socket] = field(init=False, default_factory=list)
    master: Child = field(init=False)
    client: httpx.AsyncClient = field(init=False)

    async def start_master(self) -> None:
        """Start the master and wait until it answers.

        Raises:
            MasterUnreachable: the master ends, or is not ready in time.
        """
        running = await start_master(
            self.processes, DEMO_CELL, self.folder / "master", "--public-reads",
            host=self.switch.address, port=PORT, ready_s=START_S,
        )  # fmt: skip
        self.master, self.url = running.child, running.url
        self.unit_token, self.operator_token = running.unit_token_file, running.operator_token_file
        self.client = httpx.AsyncClient(base_url=self.url, trust_env=False)

    async def warm_up(self) -> None:
        """Fill the cache with all kernels, as on a unit that ran before.

        Raises:
            FaultError: the kernels cannot be compiled.
        """
        child = await self.processes.start("warm-up", "simulation.fleet.warm_up", may_end=True)
        if await child.process.wait():
            raise FaultError(f"warm-up: expected the kernels to compile, got {child.ended}; {child.log_tail()}")

    async def start_robot(self, late_ms: float = 0.0) -> Child:
        """Start the robot's controller. Its joints reach the master `late_ms` late, and their `at_ns` says so."""
        return await self.processes.start(
            f"robot-{late_ms:g}", "simulation.fleet.controller",
            *("--url", self.url, "--token-file", str(self.operator_token), "--late-ms", str(late_ms)),
        )  # fmt: skip

    async def plug_in(self, index: int) -> PluggedUnit:
        """Start a new unit. Its configuration has a camera, a token and a state folder: no URL, no pose, no cell."""
        number = index + 1
        folder = self.folder / f"unit{number}"
        folder.mkdir()
        socket = Socket(number, FIRST_HOST + index)
        self.sockets.append(socket)
        token = folder / "token"
        token.write_text(self.unit_token.read_text())
        handling = folder / "handling.json"
        source = SimulatedSourceConfig(camera=index, cameras=UNITS, knows_pose=False)
        document = {
            "source": source.model_dump(mode="json", exclude_defaults=True) | {"kind": source.kind},
            "token_file": str(token),
            "state_dir": str(folder / "state"),
        }
        config = folder / "unit.yaml"
        config.write_text(yaml.safe_dump(document, sort_keys=False))
        started_ns = monotonic_ns()
        child = await self.processes.start(
            f"unit{number}", UNIT_MODULE, str(config), "--handling", str(handling),
            under=socket.under,
            # The reports are recorded for the judge; the unit's configuration does not mention it.
            variables={f"{UNIT_PREFIX}TRACE_PATH": str(folder / TRACE)},
        )  # fmt: skip
        unit = PluggedUnit(number, folder, socket, source, handling, child, started_ns)
        self.units.append(unit)
        return unit

    def close(self) -> None:
        """Remove all networks, after the processes have ended."""
        for socket in self.sockets:
            socket.close()

    # ------------------------------------------------------------------ what is found

    async def rows(self) -> list[dict[str, Any]]:
        """Return the rows of `GET /units`."""
        rows: list[dict[str, Any]] = (await self.client.get("/units")).raise_for_status().json()
        return rows

    async def row(self, unit: PluggedUnit) -> dict[str, Any] | None:
        """Return the row of the unit at this address, or None."""
        return next((row for row in await self.rows() if row["ip"] == unit.socket.address), None)

    async def when(
        self, unit: PluggedUnit, holds: Callable[[dict[str, Any]], bool], what: str, timeout_s: float
    ) -> tuple[dict[str, Any], int]:
        """Poll until `holds` is true of the unit's row. Return the row and the time, ns.

        Raises:
            FaultError: no row satisfies `holds` within `timeout_s`, or the unit ended.
        """
        last: dict[str, Any] | None = None

        async def poll() -> dict[str, Any] | None:
            nonlocal last
            if unit.child.failed:
                raise FaultError(f"{unit.name}: {unit.child.ended}; {unit.child.log_tail()}")
            last = await self.row(unit)
            return last if last is not None and holds(last) else None

        row = await until_async(
            poll, f"{unit.name}: {what}", timeout_s, lambda: f"last {last}; {unit.child.log_tail()}"
        )
        return row, monotonic_ns()

    async def when_live(self, unit: PluggedUnit, timeout_s: float) -> tuple[dict[str, Any], int]:
        """Poll until the unit is live. See `when`."""
        return await self.when(unit, lambda row: row["state"] == "live", "live", timeout_s)

    async def seen_share(self) -> float:
        """Return the share of the cell that is seen now."""
        return float((await self.client.get("/coverage")).raise_for_status().json()["seen_share"])

    def digests(self) -> dict[str, str]:
        """Return the SHA-256 of each file that a person could edit: configurations, tokens and the cell."""
        files = [*self.folder.glob("unit*/unit.yaml"), *self.folder.glob("unit*/token")]
        files += [self.unit_token, self.operator_token, *DEMO_CELL.parent.iterdir()]
        return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(files)}


def pose_of(row: dict[str, Any]) -> Transform:
    """Return `T_world_camera` of a unit that has a pose."""
    return np.array(row["T_world_camera"], np.float64)


async def until_async(
    poll: Callable[[], Awaitable[Found | None]], what: str, timeout_s: float, last: Callable[[], str]
) -> Found:
    """Poll `poll` until it returns something other than None, and return that.

    Raises:
        FaultError: `poll` returns None for `timeout_s`.
    """
    deadline_ns = monotonic_ns() + round(timeout_s * NS_PER_S)
    while True:
        found = await poll()
        if found is not None:
            return found
        if monotonic_ns() > deadline_ns:
            raise FaultError(f"{what}: expected within {timeout_s:g} s, did not happen; {last()}")
        await asyncio.sleep(POLL_S)
