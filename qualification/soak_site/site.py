# SPDX-License-Identifier: Apache-2.0
"""A cell with several faults at once: each fault begins, is held for a while, and is undone."""

from __future__ import annotations

import asyncio
import random
import signal
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import yaml
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException

from edge_unit.sources.simulated import SimulatedSourceConfig
from qualification.fault_site.clock import WallClock
from qualification.fault_site.scene import FPS, IMAGE, NEWCOMER, RESIDENTS, T_WORLD_CAMERA, Thing, show
from qualification.fault_site.site import ADDRESSES, FaultError, Site
from qualification.fault_site.watch import SLACK_S, STALE_AFTER_S, Answer, Observer, Poller, Subscriber
from qualification.networks import MASTER_IP, UNIT_IP, Cable
from qualification.soak_site.schedule import Kind
from shared.clock import NS_PER_S, monotonic_ns
from shared.waiting import within
from simulation.fleet.processes import Child

GRACE_NS = round((STALE_AFTER_S + 1.0 / FPS + SLACK_S) * NS_PER_S)
"""Time after a change of the scene in which the map may still show the scene before it."""

HOUR_S = 3600

STREAMS = 6
"""Readers that connect at the same time; every other one reads nothing."""

AGAIN_S = 0.05
"""Time between attempts of an operator whose master is gone."""

VOXEL_SIZES_M = (0.04, 0.03, 0.05)

READ_S = 1.0
"""Timeout of a reader: twice the stream's heartbeat."""

RECENT = 200
"""Number of newest answers that are not judged yet, and of scene changes that are kept."""

KINDS: Mapping[str, Kind] = {
    # Kept results have these names of faults.
    "unit 1 killed": Kind("unit 1", 1.0),
    "unit 1 stopped by its service": Kind("unit 1", 1.0),
    "unit 1 stands still": Kind("unit 1", 1.0),
    "unit 2 killed": Kind("unit 2", 0.5, early=True),
    "unit 2 stands still": Kind("unit 2", 1.0),
    "master killed": Kind("master", 0.7, early=True),
    "master stands still": Kind("master", 0.7),
    "robot silent": Kind("robot", 1.0),
    "camera 1 unplugged": Kind("camera 1", 1.0),
    "camera 2 unplugged": Kind("camera 2", 1.0),
    "cable pulled": Kind("cable", 1.0),
    "wall clocks step": Kind("clock", 1.0),
    "readers come and stall": Kind("readers", 1.0),
    "a setting changes": Kind("settings", 0.7),
    "the voxel size changes": Kind("settings", 0.7),
    "an operator looks around": Kind("operator", 1.0),
    "somebody comes by": Kind("newcomer", 2.0),
}


@dataclass
class Camera:
    """One camera: the things in its view, and `plugged`, which is false while it is unplugged."""

    folder: Path
    things: tuple[Thing, ...]
    plugged: bool = True

    def update(self) -> None:
        """Write the image of the current state. It holds from the next frame on."""
        if self.plugged:
            show(self.folder, *self.things)
        else:
            (self.folder / IMAGE).unlink(missing_ok=True)


class Scene:
    """The things in the cell over time."""

    def __init__(self) -> None:
        names = frozenset(thing.name for thing in RESIDENTS)
        self._since: deque[tuple[int, frozenset[str], frozenset[str]]] = deque(((0, names, names),), maxlen=RECENT)

    def change(self, certainly: Iterable[str], perhaps: Iterable[str] = ()) -> None:
        """Record that these things are in the cell from now on. Those in `perhaps` are about to appear or to leave."""
        certain = frozenset(certainly)
        self._since.append((monotonic_ns(), certain, certain.union(perhaps)))

    def around(self, now_ns: int) -> tuple[frozenset[str], frozenset[str]]:
        """Return the things present in all of the `GRACE_NS` before `now_ns`, and those present in any part."""
        always, ever = None, frozenset[str]()
        for since_ns, certain, possible in reversed(self._since):
            if since_ns <= now_ns:
                always = certain if always is None else always & certain
                ever |= possible
            if since_ns <= now_ns - GRACE_NS:
                break
        return always or frozenset(), ever

    def wrong(self, answer: Answer) -> str:
        """Return the first false statement of an answer as text; empty if the answer is right."""
        if answer.now_ns is None:
            return ""
        always, ever = self.around(answer.now_ns)
        if false := always & answer.free:
            return f"free although there is the {', '.join(sorted(false))}"
        if not answer.complete:
            return ""
        if missed := always - answer.held:
            return f"complete without the {', '.join(sorted(missed))}"
        if ghosts := answer.held - ever:
            return f"complete with the {', '.join(sorted(ghosts))}, which is not there"
        if answer.units_live != len(ADDRESSES):
            return f"complete with {answer.units_live} of {len(ADDRESSES)} units"
        return ""


@dataclass(eq=False)
class SoakSite(Site):
    """A site whose first unit is at the other end of a cable, and whose wall clocks can be set."""

    scene: Scene = field(init=False, default_factory=Scene)
    wrongs: list[str] = field(init=False, default_factory=list)
    judged: int = field(init=False, default=0)
    ended: list[str] = field(init=False, default_factory=list)
    """Messages about processes that ended without being stopped."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.host = "0.0.0.0"
        self.eyes = [Camera(folder, (thing,)) for folder, thing in zip(self.cameras, RESIDENTS, strict=True)]
        for folder, pose in zip(self.cameras, T_WORLD_CAMERA, strict=True):
            (folder / "T_base_optical.txt").write_text("\n".join(" ".join(map(str, row)) for row in pose))
        self._cable = Cable()
        self._clocks = [WallClock(self.folder / f"clock{number}") for number in range(3)]

    # ------------------------------------------------------------------ starting

    async def start(self) -> None:
        """Start all processes and the observers of the map."""
        await self.start_master(self._clocks[0].environment)
        await self.start_robot()
        for index in range(len(ADDRESSES)):
            await self.start_soaked(index)
        things = (*RESIDENTS, NEWCOMER)
        self.poller, self.subscriber = Poller(self.port, things), Subscriber(self.port, things)
        self.watching = [self.poller, self.subscriber]
        for observer in self.watching:
            observer.start()

    async def start_soaked(self, index: int) -> None:
        """Start a unit with its camera."""
        source = SimulatedSourceConfig(camera=index)
        if not self.tokens[index].exists():
            self.tokens[index].write_text(self.unit_token.read_text())
        document = {
            "source": source.model_dump(mode="json", include={"kind", "camera"}),
            "master_url": f"http://{MASTER_IP if index == 0 else '127.0.0.1'}:{self.port}",
            "token_file": str(self.tokens[index]),
            "state_dir": str(self.state_dirs[index]),
            "source_address": UNIT_IP if index == 0 else ADDRESSES[index],
        }
        config = self.folder / f"unit{index + 1}.yaml"
        config.write_text(yaml.safe_dump(document))
        child = await self.processes.start(
            self._name(f"unit{index + 1}"), "qualification.soak_site.unit", str(config), str(self.cameras[index]),
            under=self._cable.under if index == 0 else (),
            variables=self._clocks[index + 1].environment,
        )  # fmt: skip
        self.units[index : index + 1] = [child]

    def close(self) -> None:
        """Remove the cable."""
        self._cable.close()

    def running(self) -> Iterator[tuple[str, int]]:
        """Yield the names and ids of all processes that run."""
        for name, child in (("master", self.master), ("robot", self.robot), *self._named_units()):
            if not child.ended:
                yield name, child.pid

    def _named_units(self) -> Iterator[tuple[str, Child]]:
        return ((f"unit {number}", child) for number, child in enumerate(self.units, 1))

    # ------------------------------------------------------------------ judging

    def begin_judging(self) -> None:
        """Discard all answers so far; only later ones count."""
        for observer in self.watching:
            observer.answers.clear()
        self.wrongs, self.judged = [], 0

    def judge(self) -> None:
        """Compare the answers since the last call with the scene, and record processes that ended."""
        for observer in self.watching:
            # The observer's thread appends to them meanwhile.
            old = observer.answers[:-RECENT]
            del observer.answers[: len(old)]
            self._judge(observer, old)
        for child in self.processes:
            if child.failed:
                child.may_end = True
                self.ended.append(f"{child.name}: {child.ended}; {child.log_tail()}")

    def judge_all(self) -> None:
        """Judge all answers that are left, at the end."""
        self.judge()
        for observer in self.watching:
            self._judge(observer, observer.answers)

    def _judge(self, observer: Observer, answers: Iterable[Answer]) -> None:
        for answer in answers:
            self.judged += 1
            if wrong := self.scene.wrong(answer):
                self.wrongs.append(f"{type(observer).__name__}, {answer.now_ns}: {wrong}")

    async def voxels(self) -> tuple[Any, ...] | None:
        """Return the map if it is complete and all units are live; otherwise None."""
        with suppress(httpx.HTTPError):
            answer = (await self.operator.get("/voxels?form=keys")).raise_for_status().json()
            if answer["complete"] and answer["units_live"] == len(ADDRESSES):
                return answer["lattice"], answer["voxels"], answer["witnesses"]
        return None

    # ------------------------------------------------------------------ what happens

    async def strike(self, name: str, hold: Callable[[], Awaitable[None]], draw: random.Random) -> None:
        """Begin the fault `name`, await `hold`, and undo the fault.

        Raises:
            FaultError: no fault has this name.
        """
        what, _, rest = name.partition(" ")
        if name in ("unit 1 killed", "unit 2 killed", "unit 1 stopped by its service"):
            await self._unit_again(int(rest[0]) - 1, "killed" in name, hold)
        elif name.endswith("stands still") or name == "robot silent":
            child = {"master": self.master, "robot": self.robot}.get(what) or self.units[int(rest[0]) - 1]
            child.process.send_signal(signal.SIGSTOP)
            await hold()
            child.process.send_signal(signal.SIGCONT)
        elif name == "master killed":
            await self.kill(self.master)
            await hold()
            before = self.operator
            await self.start_master(self._clocks[0].environment)
            await before.aclose()
        elif what == "camera":
            await self._unplugged(self.eyes[int(rest[0]) - 1], hold)
        elif name == "cable pulled":
            self._cable.pull()
            await hold()
            self._cable.plug()
        elif name == "wall clocks step":
            for clock in self._clocks:
                clock.jump(draw.choice((-HOUR_S, HOUR_S, 24 * HOUR_S)))
            await hold()
            for clock in self._clocks:
                clock.jump(0)
        elif name == "readers come and stall":
            await self._readers(hold)
        elif name == "a setting changes":
            await self._settings({"margin_base_m": 0.033}, {"margin_base_m": 0.03}, hold)
        elif name == "the voxel size changes":
            await self._settings({"voxel_size_m": draw.choice(VOXEL_SIZES_M)}, {"voxel_size_m": 0.05}, hold)
        elif name == "an operator looks around":
            await self._request_everything()
        elif name == "somebody comes by":
            await self._newcomer(hold)
        else:
            raise FaultError(f"fault: expected one of {', '.join(KINDS)}, got {name}")

    async def _unit_again(self, index: int, kill: bool, hold: Callable[[], Awaitable[None]]) -> None:
        unit = self.units[index]
        if kill:
            await self.kill(unit)
        else:
            await self.processes.stop(unit)
        await hold()
        await self.start_soaked(index)

    async def _unplugged(self, camera: Camera, hold: Callable[[], Awaitable[None]]) -> None:
        camera.plugged = False
        camera.update()
        await hold()
        camera.plugged = True
        camera.update()

    async def _newcomer(self, hold: Callable[[], Awaitable[None]]) -> None:
        camera, residents = self.eyes[0], [thing.name for thing in RESIDENTS]
        # The process may lose its core between the write of the image and the record of the change.
        self.scene.change(residents, (NEWCOMER.name,))
        camera.things = (RESIDENTS[0], NEWCOMER)
        camera.update()
        self.scene.change((*residents, NEWCOMER.name))
        await hold()
        self.scene.change(residents, (NEWCOMER.name,))
        camera.things = (RESIDENTS[0],)
        camera.update()
        self.scene.change(residents)

    async def _settings(
        self, changed: dict[str, float], usual: dict[str, float], hold: Callable[[], Awaitable[None]]
    ) -> None:
        await self._insist(changed)
        await hold()
        await self._insist(usual)

    async def _insist(self, settings: dict[str, float]) -> None:
        """Repeat the PUT until the master acknowledges it."""
        while True:
            with suppress(httpx.HTTPError):
                (await self.operator.put("/settings", json=settings)).raise_for_status()
                return
            await asyncio.sleep(AGAIN_S)

    async def _request_everything(self) -> None:
        """Request all that an operator can request. Refusals are no failure here."""
        with suppress(httpx.HTTPError):
            for path in ("/metrics", "/coverage?blocks=true", "/robot", "/cell", "/voxels?form=centres&unseen=true"):
                await self.operator.get(path)
            for row in (await self.operator.get("/units")).raise_for_status().json():
                for kind in ("depth", "expected", "foreground"):
                    await self.operator.get(f"/units/{row['id']}/images/{kind}", timeout=10.0)
                await self.operator.post(f"/units/{row['id']}/refine")

    async def _readers(self, hold: Callable[[], Awaitable[None]]) -> None:
        """Connect readers to the stream and abort them. Every other one never receives a message."""
        ended = asyncio.Event()

        async def read(number: int) -> None:
            address = f"ws://127.0.0.1:{self.port}/stream?unseen=true"
            with suppress(OSError, TimeoutError, WebSocketException):
                async with AsyncExitStack() as stack:
                    stream = await stack.enter_async_context(connect(address, proxy=None, open_timeout=2.0))
                    stack.callback(stream.transport.abort)
                    while not ended.is_set():
                        await within(READ_S, ended.wait() if number % 2 else stream.recv())

        readers = [asyncio.ensure_future(read(number)) for number in range(STREAMS)]
        await hold()
        ended.set()
        await asyncio.gather(*readers)
