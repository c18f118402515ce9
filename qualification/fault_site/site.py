# SPDX-License-Identifier: Apache-2.0
"""A master, two units and a robot's controller as real processes, and all actions on them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import httpx
import yaml

from qualification.fault_site.scene import (
    CAMERAS_M,
    FPS,
    NEWCOMER,
    RESIDENTS,
    T_WORLD_CAMERA,
    show,
    write_camera,
    write_cell,
)
from qualification.fault_site.watch import SETTLED_S, Observer, Poller, Present, Subscriber, good
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, MasterUnreachable
from simulation.fleet.processes import Child, Processes
from simulation.fleet.running_master import start_master

ADDRESSES = ("127.0.0.2", "127.0.0.3")

SERIALS = ("ONE", "TWO")

START_S = 240.0
"""Time limit for processes to start on a busy machine, including the compilation of kernels."""

RETURN_S = 15.0
"""Time limit for a complete map to return. A longer time has missed its mark anyway."""

CHECK_S = 0.005
"""Time between two checks of a log, or of the map's answers."""

SETTING = {"margin_base_m": 0.031}
"""Setting that is acknowledged before each fault. No process may lose it."""

Found = TypeVar("Found")


class FaultError(CellwatchError):
    """A figure could not be measured."""


@dataclass(eq=False)
class Site:
    """All processes and files of one fault. `folder` holds configurations, tokens, state, images and logs."""

    folder: Path
    processes: Processes
    host: str = "127.0.0.1"
    port: int = 0
    present: list[Present] = field(init=False, default_factory=list)
    units: list[Child] = field(init=False, default_factory=list)
    master: Child = field(init=False)
    robot: Child = field(init=False)
    operator: httpx.AsyncClient = field(init=False)
    poller: Poller = field(init=False)
    subscriber: Subscriber = field(init=False)
    watching: list[Observer] = field(init=False, default_factory=list)
    cameras: list[Path] = field(init=False)
    _starts: int = field(init=False, default=0)
    _before: Any = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.cell = write_cell(self.folder)
        self.cameras = [write_camera(self.folder / f"camera{i + 1}", i) for i in range(len(CAMERAS_M))]
        self.state_dirs = [self.folder / f"unit{i + 1}" for i in range(len(CAMERAS_M))]
        self.addresses = list(ADDRESSES)
        self.tokens = [self.folder / f"unit{i + 1}.token" for i in range(len(CAMERAS_M))]
        self.master_state = self.folder / "master"

    # ------------------------------------------------------------------ starting

    async def start_master(self, variables: Mapping[str, str] | None = None) -> None:
        """Start the master, at the same port as before, and wait until it answers.

        Raises:
            FaultError: the master ends instead.
        """
        try:
            running = await start_master(
                self.processes, self.cell, self.master_state, "--public-reads",
                name=self._name("master"), host=self.host, port=self.port, variables=variables, ready_s=START_S,
            )  # fmt: skip
        except MasterUnreachable as error:
            raise FaultError(str(error)) from error
        self.master, self.port = running.child, running.port
        self.unit_token, self.operator_token = running.unit_token_file, running.operator_token_file
        self.operator = httpx.AsyncClient(
            base_url=f"http://127.0.0.1:{self.port}", headers=running.as_operator, trust_env=False
        )

    async def start_robot(self) -> None:
        """Start the robot's controller."""
        self.robot = await self.processes.start(
            self._name("robot"), "simulation.fleet.controller",
            *("--url", f"http://127.0.0.1:{self.port}", "--token-file", str(self.operator_token), "--rate", "20"),
        )  # fmt: skip

    async def start_unit(
        self,
        index: int,
        url: str | None = None,
        address: str | None = None,
        under: Sequence[str] = (),
        variables: Mapping[str, str] | None = None,
    ) -> Child:
        """Start a unit. It gets no pose, because the master keeps it."""
        if not self.tokens[index].exists():
            self.tokens[index].write_text(self.unit_token.read_text())
        document = {
            "source": {"kind": "recorded", "folder": str(self.cameras[index]), "serial": SERIALS[index], "fps": FPS},
            "master_url": url or f"http://127.0.0.1:{self.port}",
            "token_file": str(self.tokens[index]),
            "state_dir": str(self.state_dirs[index]),
            "source_address": address or self.addresses[index],
        }
        config = self.folder / f"{SERIALS[index]}.yaml"
        config.write_text(yaml.safe_dump(document))
        name = self._name(f"unit{index + 1}")
        child = await self.processes.start(
            name, "qualification.fault_site.unit", str(config), under=under, variables=variables
        )
        self.units[index : index + 1] = [child]
        return child

    async def calm(self) -> None:
        """Set the poses of all cameras, wait until the map is complete and right, and start the observers.

        Raises:
            FaultError: the map does not become complete.
        """
        await until(lambda: all(registered(unit) for unit in self.units), "two registered units")
        await self.set_poses()
        response = await self.operator.put("/settings", json=SETTING)
        response.raise_for_status()
        since_ns = monotonic_ns()
        self.present = [Present(thing, since_ns) for thing in RESIDENTS]
        things = (*RESIDENTS, NEWCOMER)
        self.poller, self.subscriber = Poller(self.port, things), Subscriber(self.port, things)
        self.watching = [self.poller, self.subscriber]
        for observer in self.watching:
            observer.start()
        await self.settled(START_S)
        for observer in self.watching:
            observer.answers.clear()
        self._before = await self.acknowledged()
        await asyncio.sleep(SETTLED_S)

    async def stop_observers(self) -> None:
        """Stop all observers. It may be called again."""
        for observer in self.watching:
            await asyncio.to_thread(observer.stop)
        self.watching = []

    async def set_poses(self) -> None:
        """Set the pose of each camera, as an operator would."""
        for row in (await self.operator.get("/units")).json():
            pose = T_WORLD_CAMERA[SERIALS.index(row["serial"])]
            answer = await self.operator.put(f"/units/{row['id']}/pose", json={"T_world_camera": pose})
            answer.raise_for_status()

    # ------------------------------------------------------------------ actions

    def newcomer(self) -> None:
        """Add a thing that only the first unit can see."""
        show(self.cameras[0], RESIDENTS[0], NEWCOMER)
        self.present.append(Present(NEWCOMER, monotonic_ns()))

    async def kill(self, child: Child) -> None:
        """Kill a process, and wait for its end."""
        child.may_end = True
        child.process.kill()
        await child.process.wait()

    # ------------------------------------------------------------------ results

    async def settled(self, timeout_s: float = RETURN_S) -> None:
        """Wait until the map is complete and holds all things for SETTLED_S without interruption.

        Raises:
            FaultError: the map does not settle in time.
        """
        names = {present.thing.name for present in self.present}
        began_ns = monotonic_ns()

        def look() -> bool:
            answers = self.poller.answers
            end_ns = monotonic_ns()
            if end_ns - began_ns < SETTLED_S * NS_PER_S:
                return False
            recent = [a for a in answers[-200:] if a.got_ns > end_ns - SETTLED_S * NS_PER_S]
            return bool(recent) and all(good(answer, names, len(SERIALS)) for answer in recent)

        await until(
            look, "a complete map that tells of all that is there", timeout_s, lambda: f"{self.poller.answers[-1:]}"
        )

    async def acknowledged(self) -> dict[str, Any]:
        """Return what the master has acknowledged and must keep: ids and poses by serial, and settings."""
        rows = (await self.operator.get("/units")).json()
        state = {row["serial"]: (row["ip"], row["id"], row["T_world_camera"]) for row in rows}
        return {**state, "settings": (await self.operator.get("/settings")).json()}

    async def lost(self) -> list[str]:
        """Return the names of acknowledged values that the master has lost."""
        now = await self.acknowledged()
        return [name for name, value in self._before.items() if now.get(name) != value]

    def expect(self, name: str, value: Any) -> None:
        """Record a newly acknowledged value."""
        self._before[name] = value

    def _name(self, role: str) -> str:
        self._starts += 1
        return f"{self._starts:02}-{role}"


def registered(unit: Child) -> bool:
    """Return True if a unit has logged its registration.

    Raises:
        FaultError: the unit ended instead.
    """
    if unit.failed:
        raise FaultError(f"{unit.name}: {unit.ended}; {unit.log_tail()}")
    return b"registered at" in unit.log.read_bytes()


async def until(
    look: Callable[[], Found], what: str, timeout_s: float = START_S, last: Callable[[], str] = lambda: ""
) -> Found:
    """Wait until `look` returns a true value, and return it. `last` gives the current state for the error.

    Raises:
        FaultError: not within `timeout_s`.
    """
    deadline_ns = monotonic_ns() + round(timeout_s * NS_PER_S)
    while True:
        found = look()
        if found:
            return found
        if monotonic_ns() > deadline_ns:
            raise FaultError(f"{what}: not within {timeout_s:g} s; {last()}")
        await asyncio.sleep(CHECK_S)
