# SPDX-License-Identifier: Apache-2.0
"""The simulated camera as a source: paced, latest wins, the same world for all."""

from __future__ import annotations

import asyncio
import sys
import threading
from contextlib import aclosing
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from edge_unit.sources.frame import DepthFrame, DepthSource
from edge_unit.sources.simulated import SimulatedSource, SimulatedSourceConfig
from shared.cell import Cell
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import SourceError
from shared.transforms import from_xyz_rpy
from simulation.cameras.camera import SimulatedCamera, SimulatedFrame, d435i_intrinsics, rig
from simulation.world.handling import LEFT_ALONE, Handling, Hands
from simulation.world.world import DEMO_CELL, World

pytestmark = pytest.mark.alone

WAIT_S = 20.0
"""Kernels may have to be compiled first."""


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(DEMO_CELL)


async def take(source: DepthSource, count: int, pause_s: float = 0.0) -> list[DepthFrame]:
    """The next frames, read by somebody who needs `pause_s` for each."""
    found: list[DepthFrame] = []
    async with aclosing(source.frames()) as frames:
        async for frame in frames:
            found.append(frame)
            if len(found) == count:
                break
            await asyncio.sleep(pause_s)
    return found


async def test_frames_come_when_they_are_due_and_are_those_of_the_world(cell: Cell) -> None:
    epoch_ns = monotonic_ns()
    source = SimulatedSource(SimulatedSourceConfig(camera=1, fps=20.0, epoch_ns=epoch_ns, seed=3))
    try:
        info = await asyncio.wait_for(source.open(), WAIT_S)
        opened_ns = monotonic_ns()
        frames = await asyncio.wait_for(take(source, 4), WAIT_S)
        taken_ns = monotonic_ns()
    finally:
        await source.close()
    world = World.demo(people=1, seed=3, cell=cell)
    assert info.serial == "SIM0000301"
    assert info.intrinsics == d435i_intrinsics(424, 240)
    np.testing.assert_array_equal(info.T_world_camera, rig(world.cell, 4)[1])
    assert info.T_world_camera is not None
    camera = SimulatedCamera(world, info.T_world_camera, info.intrinsics, seed=3 * 64 + 1)
    for frame in frames:
        # The second of four cameras is a quarter of a period late.
        assert frame.captured_at_ns == epoch_ns + frame.frame_number * 50 * NS_PER_MS + 50 * NS_PER_MS // 4
        assert opened_ns <= frame.captured_at_ns <= taken_ns
        assert frame.joints is None
        expected = camera.capture((frame.captured_at_ns - epoch_ns) / NS_PER_S)
        np.testing.assert_array_equal(frame.depth, expected.depth)
    assert [b.frame_number > a.frame_number for a, b in pairwise(frames)] == [True] * 3


async def test_a_slow_reader_skips_and_never_lags() -> None:
    period_ns = NS_PER_S // 50
    source = SimulatedSource(SimulatedSourceConfig(fps=50.0, epoch_ns=monotonic_ns()))
    try:
        await asyncio.wait_for(source.open(), WAIT_S)
        ages_ns = []
        numbers = []
        async with aclosing(source.frames()) as frames:
            async for frame in frames:
                ages_ns.append(monotonic_ns() - frame.captured_at_ns)
                numbers.append(frame.frame_number)
                if len(numbers) == 4:
                    break
                await asyncio.sleep(0.1)
    finally:
        await source.close()
    assert min(np.diff(numbers)) >= 4
    # At most one period old when it was begun; the rest is rendering on a machine that may be busy.
    assert min(ages_ns) < 3 * period_ns


async def test_closing_ends_the_frames_and_it_opens_again() -> None:
    source = SimulatedSource(SimulatedSourceConfig(fps=0.01, epoch_ns=monotonic_ns()))
    await asyncio.wait_for(source.open(), WAIT_S)
    waiting = asyncio.ensure_future(take(source, 1))
    await asyncio.sleep(0)
    await source.close()
    assert await asyncio.wait_for(waiting, WAIT_S) == []
    await source.close()
    with pytest.raises(SourceError, match="to be opened before"):
        await take(source, 1)
    await asyncio.wait_for(source.open(), WAIT_S)
    await source.close()


class Observed:
    """An observer that notes all calls, and the thread of each."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.threads: set[str] = set()
        self.cameras: list[SimulatedCamera] = []
        self.frames: dict[int, tuple[int, SimulatedFrame]] = {}

    def _note(self, call: str) -> None:
        self.calls.append(call)
        self.threads.add(threading.current_thread().name.rpartition("_")[0])

    def place(self, camera: SimulatedCamera) -> None:
        self._note("place")
        self.cameras.append(camera)

    def observe(self, captured_at_ns: int, frame_number: int, frame: SimulatedFrame) -> None:
        self._note("observe")
        self.frames[frame_number] = captured_at_ns, frame

    def close(self) -> None:
        self._note("close")


async def test_an_observer_receives_each_frame_with_the_truth_behind_it(tmp_path: Path) -> None:
    epoch_ns, observed, handling = monotonic_ns(), Observed(), tmp_path / "handling.json"
    config = SimulatedSourceConfig(fps=30.0, epoch_ns=epoch_ns)
    source = SimulatedSource(config, Hands(handling), observed)
    try:
        await asyncio.wait_for(source.open(), WAIT_S)
        frames = await asyncio.wait_for(take(source, 3), WAIT_S)
        await asyncio.to_thread(Handling(xyz=(0.02, 0.0, 0.0)).write, handling)
        frames += await asyncio.wait_for(take(source, 1), WAIT_S)
    finally:
        await source.close()
    assert observed.calls == ["place", "observe", "observe", "observe", "place", "observe", "close"]
    assert observed.threads == {"simulated-camera"}
    assert list(observed.frames) == [frame.frame_number for frame in frames]
    for frame, camera in zip(frames, [observed.cameras[0]] * 3 + observed.cameras[1:], strict=True):
        captured_at_ns, whole = observed.frames[frame.frame_number]
        assert captured_at_ns == frame.captured_at_ns
        np.testing.assert_array_equal(whole.depth, frame.depth)
        view = camera.look((captured_at_ns - epoch_ns) / NS_PER_S)
        np.testing.assert_array_equal(whole.view.z_m, view.z_m)


@pytest.mark.parametrize("option", ["truth_path", "truth_voxel_size_m", "handling"])
def test_no_configuration_reaches_the_evaluation(option: str) -> None:
    with pytest.raises(ValidationError, match=option):
        SimulatedSourceConfig.model_validate({option: "1"})


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"camera": 4, "cameras": 4}, "expected a camera below 4, got 4"),
        ({"width": 100}, "resolution: expected one of"),
        ({"cell": "/nowhere/cell.yaml"}, "/nowhere/cell.yaml"),
    ],
)
async def test_what_cannot_be_simulated_is_one_clear_error(settings: dict[str, object], text: str) -> None:
    source = SimulatedSource(SimulatedSourceConfig.model_validate(settings))
    with pytest.raises(SourceError, match=text):
        await asyncio.wait_for(source.open(), WAIT_S)


async def test_without_the_simulation_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "simulation.cameras.camera", None)
    with pytest.raises(SourceError, match=r"pip install 'cellwatch\[sim\]'"):
        await asyncio.wait_for(SimulatedSource(SimulatedSourceConfig()).open(), WAIT_S)


@pytest.mark.parametrize("bad", [{"fps": 0.0}, {"people": 3}, {"seed": -1}, {"lens": 1}, {"kind": "realsense"}])
def test_a_wrong_configuration_is_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        SimulatedSourceConfig.model_validate(bad)


async def test_a_camera_that_is_knocked_covered_and_exchanged(cell: Cell, tmp_path: Path) -> None:
    handling = tmp_path / "handling.json"
    source = SimulatedSource(SimulatedSourceConfig(camera=1, fps=30.0, people=0), Hands(handling))
    knock = Handling(xyz=(0.02, 0.0, 0.01), rpy_deg=(1.0, 0.0, -2.0))
    try:
        info = await asyncio.wait_for(source.open(), WAIT_S)
        assert info.T_world_camera is not None
        before = (await asyncio.wait_for(take(source, 1), WAIT_S))[0]
        await asyncio.to_thread(knock.write, handling)
        knocked = (await asyncio.wait_for(take(source, 1), WAIT_S))[0]
        await asyncio.to_thread(Handling(covered=True).write, handling)
        covered = (await asyncio.wait_for(take(source, 1), WAIT_S))[0]
        async with source.open_images("infrared") as feed, aclosing(feed.images()) as images:
            assert not (await anext(images)).pixels.any()
        await asyncio.to_thread(LEFT_ALONE.write, handling)
        back = (await asyncio.wait_for(take(source, 1), WAIT_S))[0]
        await asyncio.to_thread(Handling(serial="ANOTHER").write, handling)
        with pytest.raises(SourceError, match="SIM0000001 was unplugged"):
            await asyncio.wait_for(take(source, 1), WAIT_S)
        await source.close()
        assert (await asyncio.wait_for(source.open(), WAIT_S)).serial == "ANOTHER"
    finally:
        await source.close()
    assert not covered.depth.any()
    world, place = World.demo(people=0, cell=cell), rig(cell, 4)[1]
    for frame, hangs in (
        (before, np.eye(4)),
        (knocked, from_xyz_rpy(knock.xyz, np.radians(knock.rpy_deg))),
        (back, np.eye(4)),
    ):
        camera = SimulatedCamera(world, place @ hangs, info.intrinsics, seed=1)
        np.testing.assert_array_equal(frame.depth, camera.capture(frame.captured_at_ns / NS_PER_S).depth)


async def test_hands_that_nobody_understands(tmp_path: Path) -> None:
    handling = tmp_path / "handling.json"
    handling.write_text('{"covered": "perhaps"}')
    source = SimulatedSource(SimulatedSourceConfig(), Hands(handling))
    with pytest.raises(SourceError, match="covered"):
        await asyncio.wait_for(source.open(), WAIT_S)
