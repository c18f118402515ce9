# SPDX-License-Identifier: Apache-2.0
"""One unit as a process: it gets the number of a frame, filters the frame, and reports it by the units' own client."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper_experiment.contenders import UnitWork
from benchmarks.paper_experiment.master import Member
from benchmarks.peers.ur3_scene import room
from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.clock import monotonic_ns
from shared.transforms import Transform
from simulation.fleet.processes import die_with_parent


@dataclass(frozen=True, eq=False)
class UseCamera:
    """Switch to another camera: `frames` is an npy file of (N, H, W) uint16, `joints` (N, n) rad belong to them."""

    intrinsics: Intrinsics
    T_world_camera: Transform
    frames: Path
    joints: NDArray[np.float64]


@dataclass(frozen=True)
class Resize:
    """Change the voxel size, and register again."""

    voxel_size_m: float


@dataclass(frozen=True)
class FilterFrame:
    """Filter frame `number` and report it. None: report that nothing unknown is there."""

    number: int | None


Command = UseCamera | Resize | FilterFrame | None
"""Command to a unit, which answers True when it is done. None: end."""


def run(commands: Connection, url: str, token: str, number: int) -> None:
    """Execute commands until the one that ends the process."""
    die_with_parent()
    asyncio.run(_Unit(commands, Member.at(url, token, number)).run())


class _Unit:
    def __init__(self, commands: Connection, member: Member) -> None:
        self._commands, self._member = commands, member
        self._cell: Cell = room()

    async def run(self) -> None:
        async with self._member.client:
            # Nothing else runs in this loop, so it may block until a command comes.
            while (command := self._commands.recv()) is not None:
                await self._execute(command)
                self._commands.send(True)

    async def _execute(self, command: UseCamera | Resize | FilterFrame) -> None:
        if isinstance(command, UseCamera):
            self._camera, self._depth = command, np.load(command.frames)
            self._work = UnitWork(DepthPipeline(command.intrinsics, command.T_world_camera, self._cell))
        elif isinstance(command, Resize):
            self._work.resize(command.voxel_size_m)
            await self._member.register(self._camera.intrinsics, self._camera.T_world_camera)
            # Compiles the missing kernels, and leaves the connection open.
            self._work.filter_frame(self._depth[0], self._camera.joints[0])
            await self._member.report(None, monotonic_ns())
        elif command.number is None:
            await self._member.report(None, monotonic_ns())
        else:
            captured_at_ns, n = monotonic_ns(), command.number
            await self._member.report(self._work.filter_frame(self._depth[n], self._camera.joints[n]), captured_at_ns)
