# SPDX-License-Identifier: Apache-2.0
"""A depth camera in the simulated cell.

The world is a pure function of the seconds since `epoch_ns`, so units that are told the same epoch and seed see
the same people at the same time. Only this source imports the simulation, and only when it is opened.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncGenerator, AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from edge_unit.sources.frame import CameraInfo, DepthFrame
from edge_unit.sources.image import ImageFrame, ImageInfo, ImageStream
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, SourceError
from shared.transforms import Transform, from_xyz_rpy, identity
from shared.waiting import within

if TYPE_CHECKING:
    from simulation.cameras.board_picture import BoardCamera
    from simulation.cameras.camera import SimulatedCamera, SimulatedFrame
    from simulation.cameras.truth import TruthFinder
    from simulation.world.handling import Handling, Hands
    from simulation.world.world import World


class SimulatedSourceConfig(BaseModel):
    """Which camera of which simulated cell."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: Literal["simulated"] = "simulated"
    camera: int = Field(default=0, ge=0, lt=50, description="Which camera of the rig.")
    cameras: int = Field(default=4, ge=1, le=50, description="How many cameras the rig has.")
    width: int = Field(default=424, description="Columns: 424, 640, 848 or 1280.")
    height: int = Field(default=240, description="Rows: 240, 480, 480 or 720.")
    fps: float = Field(default=15.0, gt=0.0, le=90.0, description="Frames a second.")
    epoch_ns: int = Field(
        default=0, ge=0, description="CLOCK_MONOTONIC in ns at which the world's time is 0; the same for all units."
    )
    people: int = Field(default=1, ge=0, le=2, description="How many people walk beside the table.")
    seed: int = Field(default=0, ge=0, le=0xFFFF, description="Decides who walks how, and all noise.")
    knows_pose: bool = Field(default=True, description="Else it must be told its pose, or find it by the board.")
    cell: Path | None = Field(default=None, description="A cell.yaml with a UR3e; the demo cell when left out.")
    handling: Path | None = Field(
        default=None, description="JSON file of what is done to the camera now: knocked, covered, exchanged."
    )
    truth_path: Path | None = Field(
        default=None, description="File to which the truth of every frame is appended, for evaluation."
    )
    truth_voxel_size_m: float = Field(default=0.05, ge=0.01, le=0.10, description="Voxel size of that truth.")

    @property
    def serial(self) -> str:
        """The camera's serial number."""
        return f"SIM{self.seed:05d}{self.camera:02d}"


class SimulatedImages:
    """Pictures of the board as the simulated camera takes them; an `ImageFeed`."""

    def __init__(self, camera: BoardCamera, hands: Hands, worker: ThreadPoolExecutor, epoch_ns: int) -> None:
        self._camera = camera
        self._hands = hands
        self._worker = worker
        self._epoch_ns = epoch_ns

    @property
    def info(self) -> ImageInfo:
        """See `ImageFeed`."""
        return ImageInfo(
            self._camera.stream, self._camera.intrinsics, (0.0,) * 5, "brown_conrady", self._camera.T_depth_image
        )

    async def images(self) -> AsyncGenerator[ImageFrame, None]:
        """See `ImageFeed`; taken as fast as they are wanted."""
        loop = asyncio.get_running_loop()
        for number in itertools.count():
            now_ns = monotonic_ns()
            t_s = (now_ns - self._epoch_ns) / NS_PER_S
            yield ImageFrame(await loop.run_in_executor(self._worker, self._take, t_s), now_ns, number)

    def _take(self, t_s: float) -> NDArray[np.uint8]:
        image = self._camera.take(t_s)
        return np.zeros_like(image) if self._hands.now().covered else image


class SimulatedSource:
    """Renders a frame whenever one is due; a `DepthSource`.

    With `truth_path`, one msgpack map a frame is appended there: `captured_at_ns`, `frame_number`, `voxel_size_m`,
    `visible_keys` and `visible_counts`, `surface_keys` (little-endian uint32 as bytes; see `simulation.cameras.truth`).
    """

    def __init__(self, config: SimulatedSourceConfig) -> None:
        self._config = config
        self._period_ns = round(NS_PER_S / config.fps)
        # Nobody triggers the cameras of a cell together; here they take turns.
        self._first_ns = config.epoch_ns + self._period_ns * config.camera // config.cameras
        self._camera: SimulatedCamera | None = None
        self._hands: Hands | None = None
        self._handled: Handling | None = None
        self._T_world_place = identity()
        self._truth: TruthFinder | None = None
        self._truth_file: BinaryIO | None = None
        self._worker: ThreadPoolExecutor | None = None
        self._closing = asyncio.Event()

    async def open(self) -> CameraInfo:
        """See `DepthSource`."""
        self._closing.clear()
        # One thread: frames and the writing of their truth never overlap.
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="simulated-camera")
        try:
            return await asyncio.get_running_loop().run_in_executor(self._worker, self._start)
        except BaseException:
            await self.close()
            raise

    async def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """See `DepthSource`. A frame is captured at the moment at which it is due, and rendered right after."""
        worker = self._worker
        if worker is None:
            raise SourceError("simulated camera: expected to be opened before its frames are read")
        loop = asyncio.get_running_loop()
        writing: asyncio.Future[None] | None = None
        number = -1
        while not self._closing.is_set():
            number = self._next_number(number, monotonic_ns())
            due_ns = self._first_ns + number * self._period_ns
            if await within((due_ns - monotonic_ns()) / NS_PER_S, self._closing.wait()):
                return
            frame = await loop.run_in_executor(worker, self._capture, due_ns)
            if writing is not None:
                await writing
            if self._truth_file is not None:
                writing = loop.run_in_executor(worker, self._write_truth, due_ns, number, frame)
            yield DepthFrame(frame.depth, due_ns, number)

    @asynccontextmanager
    async def open_images(self, stream: ImageStream) -> AsyncIterator[SimulatedImages]:
        """See `ImageSource`."""
        worker = self._worker
        if worker is None:
            raise SourceError("simulated camera: a look was asked for before it was opened")
        eye = await asyncio.get_running_loop().run_in_executor(worker, self._board_camera, stream)
        assert self._hands is not None
        yield SimulatedImages(eye, self._hands, worker, self._config.epoch_ns)

    async def close(self) -> None:
        """See `DepthSource`."""
        self._closing.set()
        worker, self._worker = self._worker, None
        if worker is not None:
            await asyncio.get_running_loop().run_in_executor(worker, self._stop)
            worker.shutdown(wait=False)

    def _next_number(self, last: int, now_ns: int) -> int:
        """The frame after `last`, or a later one when a slow reader has let more become due."""
        latest_due = (now_ns - self._first_ns) // self._period_ns
        return max(last + 1, latest_due if last >= 0 else latest_due + 1, 0)

    def _start(self) -> CameraInfo:
        """Build the world; imports the simulation, which a unit without it does not have."""
        config = self._config
        try:
            from simulation.cameras.camera import d435i_intrinsics, rig
            from simulation.world.handling import Hands
            from simulation.world.world import World
        except ImportError as error:
            raise SourceError(
                f"simulated camera: expected the simulation to be installed (pip install 'cellwatch[sim]'): {error}"
            ) from error
        if config.camera >= config.cameras:
            raise SourceError(f"simulated camera: expected a camera below {config.cameras}, got {config.camera}")
        try:
            intrinsics = d435i_intrinsics(config.width, config.height)
            world = World.demo(config.people, config.seed, Cell.load(config.cell) if config.cell else None)
            pose = rig(world.cell, config.cameras)[config.camera]
            world.cell.lattice(config.truth_voxel_size_m)
        except CellwatchError as error:
            raise SourceError(f"simulated camera: {error}") from error
        self._hands = Hands(config.handling)
        handled = self._hands.now()
        self._hang(world, pose, intrinsics, handled)
        if config.truth_path is not None:
            try:
                self._truth_file = config.truth_path.open("ab")
            except OSError as error:
                raise SourceError(f"simulated camera: truth_path: {error}") from error
        serial = handled.serial or config.serial
        return CameraInfo(serial, "Simulated D435i", intrinsics, pose if config.knows_pose else None)

    def _hang(self, world: World, T_world_place: Transform, intrinsics: Intrinsics, handled: Handling) -> None:
        """Hang the camera where hands put it. The first frame compiles what is not in the cache yet."""
        from simulation.cameras.camera import SimulatedCamera
        from simulation.cameras.truth import TruthFinder

        config = self._config
        pose = T_world_place @ from_xyz_rpy(handled.xyz, np.radians(handled.rpy_deg))
        camera = SimulatedCamera(world, pose, intrinsics, seed=config.seed * 64 + config.camera)
        first = camera.capture(0.0)
        if config.truth_path is not None:
            lattice = world.cell.lattice(config.truth_voxel_size_m)
            self._truth = TruthFinder(intrinsics, pose, lattice, camera.noise)
            self._truth.find(first.view)
        self._camera, self._handled, self._T_world_place = camera, handled, T_world_place

    def _board_camera(self, stream: ImageStream) -> BoardCamera:
        from simulation.cameras.board_picture import BoardCamera

        camera, config = self._camera, self._config
        assert camera is not None
        try:
            return BoardCamera(camera.world, camera.T_world_camera, stream, config.seed * 64 + config.camera)
        except CellwatchError as error:
            raise SourceError(f"simulated camera: {error}") from error

    def _stop(self) -> None:
        if self._truth_file is not None:
            self._truth_file.close()
        self._camera, self._hands, self._truth, self._truth_file = None, None, None, None

    def _capture(self, due_ns: int) -> SimulatedFrame:
        assert self._camera is not None
        assert self._hands is not None
        assert self._handled is not None
        handled, before = self._hands.now(), self._handled
        if handled.serial != before.serial:
            raise SourceError(f"simulated camera: {before.serial or self._config.serial} was unplugged")
        if (handled.xyz, handled.rpy_deg) != (before.xyz, before.rpy_deg):
            self._hang(self._camera.world, self._T_world_place, self._camera.intrinsics, handled)
        frame = self._camera.capture((due_ns - self._config.epoch_ns) / NS_PER_S)
        return replace(frame, depth=np.zeros_like(frame.depth)) if handled.covered else frame

    def _write_truth(self, captured_at_ns: int, frame_number: int, frame: SimulatedFrame) -> None:
        assert self._truth is not None
        assert self._truth_file is not None
        truth = self._truth.find(frame.view)
        record = {
            "captured_at_ns": captured_at_ns,
            "frame_number": frame_number,
            "voxel_size_m": self._config.truth_voxel_size_m,
            "visible_keys": truth.visible_keys.astype("<u4").tobytes(),
            "visible_counts": truth.visible_counts.astype("<u4").tobytes(),
            "surface_keys": truth.surface_keys.astype("<u4").tobytes(),
        }
        self._truth_file.write(msgpack.packb(record))
        self._truth_file.flush()
