# SPDX-License-Identifier: Apache-2.0
"""A master, simulated units and the robot's controller, each in its own process, as in a real cell.

Each unit connects from its own IP address: 127.0.0.2, .3 ... (all of 127.0.0.0/8 is this machine).
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Address
from pathlib import Path

import httpx
import yaml

from edge_unit.config import ENVIRONMENT_PREFIX as UNIT_PREFIX
from edge_unit.sources.simulated import SimulatedSourceConfig
from shared.clock import monotonic_ns
from shared.errors import ConfigError
from simulation.fleet.evaluation import UnitRun
from simulation.fleet.processes import Child, Processes
from simulation.fleet.running_master import RunningMaster, start_master
from simulation.fleet.unit import MODULE as UNIT_MODULE
from simulation.fleet.unit import arguments_of
from simulation.world.world import DEMO_CELL

MASTER_PREFIX = "CELLWATCH_MASTER_"
"""Prefix of the environment variables that configure a real master."""

FIRST_ADDRESS = IPv4Address("127.0.0.2")
"""Address of the first unit; 127.0.0.1 is the master's."""

QUIET_S = 5.0
"""The warm-up takes less time than this if all kernels are compiled, unless the machine is very busy."""

START_S = 240.0
"""Timeout for the start of the master on a slow and busy machine."""

LOG_LEVEL = ("--log-level", "WARNING")


@dataclass(frozen=True)
class FleetOptions:
    """Number of units, their cameras and the world."""

    units: int = 4
    people: int = 1
    seed: int = 0
    fps: float = 15.0
    width: int = 424
    height: int = 240
    voxel_size_m: float = 0.05
    port: int = 0
    recorded: bool = False
    """True if the units record their frames and the truth, for evaluation."""


@dataclass(eq=False)
class FleetUnit:
    """One unit of the fleet."""

    name: str
    address: str
    run: UnitRun
    child: Child
    config_path: Path


@dataclass(eq=False)
class Fleet:
    """All processes of the fleet. `folder` holds configurations, tokens, state, logs and records."""

    options: FleetOptions
    folder: Path
    processes: Processes = field(init=False)
    units: list[FleetUnit] = field(init=False, default_factory=list)
    master: Child = field(init=False)
    url: str = field(init=False)
    _running: RunningMaster = field(init=False)

    def __post_init__(self) -> None:
        # The environment may configure real units and masters; these here must not see it.
        self.processes = Processes(self.folder / "logs", without=(UNIT_PREFIX, MASTER_PREFIX))

    async def start_master(self, actions: Mapping[str, str] | None = None) -> None:
        """Start the master and wait until it answers. Its viewer offers `actions` of an operator on a unit.

        Raises:
            MasterUnreachable: the master ended, or was not ready in time.
        """
        self._running = await start_master(
            self.processes,
            DEMO_CELL,
            self.folder / "master",
            *("--public-reads", "--set", f"settings.voxel_size_m={self.options.voxel_size_m}", *LOG_LEVEL),
            *(part for name, url in (actions or {}).items() for part in ("--set", f"unit_actions.{name}={url}")),
            port=self.options.port,
            ready_s=START_S,
        )
        self.master, self.url = self._running.child, self._running.url

    async def viewer_link(self) -> str | None:
        """Return a link into the master's viewer for the operator; None if no viewer is installed."""
        async with httpx.AsyncClient(base_url=self.url, headers=self._running.as_operator, trust_env=False) as client:
            answer = await client.post("/viewer/links")
        return f"{self.url}{answer.json()['path']}" if answer.is_success else None

    async def switch_power(self, verb: str, address: str) -> str | None:
        """Cut a unit's power (`cut`) or restore it (`give`). Return the reason of a refusal, or None."""
        unit = next((unit for unit in self.units if unit.address == address), None)
        if unit is None:
            return f"expected the address of one of the {len(self.units)} units, got {address}"
        if verb == "cut":
            if unit.child.ended:
                return f"{unit.name} has no power already"
            unit.child.may_end = True
            unit.child.process.kill()
            await unit.child.process.wait()
        elif not unit.child.ended:
            return f"{unit.name} has power already"
        else:
            unit.child = await self._run_unit(unit.run, unit.config_path)
        return None

    async def start_warm_up(self) -> asyncio.Future[None]:
        """Start to compile all kernels, once for all units. The future is done when all are compiled.

        The future raises a ConfigError if the kernels cannot be compiled.
        """
        child = await self.processes.start("warm-up", "simulation.fleet.warm_up", may_end=True)

        async def finish() -> None:
            if await child.process.wait():
                raise ConfigError(f"warm-up: expected the kernels to compile, got {child.ended}; {child.log_tail()}")

        return asyncio.ensure_future(finish())

    async def start_units(self) -> None:
        """Start the robot's controller and all units. The time of their world begins now."""
        epoch_ns = monotonic_ns()
        await self.processes.start(
            "robot",
            "simulation.fleet.controller",
            *("--url", self.url, "--token-file", str(self._running.operator_token_file), "--epoch-ns", str(epoch_ns)),
        )
        for index in range(self.options.units):
            await self._start_unit(index, epoch_ns)

    async def _start_unit(self, index: int, epoch_ns: int) -> None:
        options, name = self.options, f"unit-{index + 1}"
        state_dir = self.folder / name
        state_dir.mkdir(parents=True)
        source = SimulatedSourceConfig(
            camera=index,
            cameras=options.units,
            width=options.width,
            height=options.height,
            fps=options.fps,
            epoch_ns=epoch_ns,
            people=options.people,
            seed=options.seed,
        )
        address = str(FIRST_ADDRESS + index)
        trace_path = state_dir / "trace.msgpack"
        document = {
            "source": source.model_dump(mode="json"),
            "master_url": self.url,
            "token_file": str(self._running.unit_token_file),
            "state_dir": str(state_dir),
            "source_address": address,
            "trace_path": str(trace_path) if options.recorded else None,
        }
        config_path = state_dir / "unit.yaml"
        config_path.write_text(yaml.safe_dump(document, sort_keys=False))
        run = UnitRun(name, source, trace_path, state_dir / "truth.msgpack")
        child = await self._run_unit(run, config_path)
        self.units.append(FleetUnit(name, address, run, child, config_path))

    async def _run_unit(self, run: UnitRun, config_path: Path) -> Child:
        evaluated = arguments_of(run.truth_path if self.options.recorded else None, self.options.voxel_size_m, None)
        return await self.processes.start(run.name, UNIT_MODULE, str(config_path), *evaluated, *LOG_LEVEL)
