# SPDX-License-Identifier: Apache-2.0
"""A depth camera in the simulated cell.

The world is a pure function of the seconds since `epoch_ns`. Units with the same epoch and seed therefore see the same
people at the same time. Only this source imports the simulation, and only when it is opened.

The configuration describes a camera and nothing else. An evaluation constructs `SimulatedSource` itself, and passes a
`FrameObserver` and `Hands` to it.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncGenerator, AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

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
    from simulation.world.handling import Handling, Hands
    from simulation.world.world import World


class SimulatedSourceConfig(BaseModel):
    """The camera, its stream, and the simulated cell that it sees."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: Literal["simulated"] = "simulated"
    camera: int = Field(default=0, ge=0, lt=50, description="Index of the camera in the rig.")
    cameras: int = Field(default=4, ge=1, le=50, description="Number of cameras in the rig.")
    width: int = Field(default=424, description="Columns: 424, 640, 848 or 1280.")
    height: int = Field(default=240, description="Rows: 240, 480, 480 or 720.")
    fps: float = Field(default=15.0, gt=0.0, le=90.0, description="Frames a second.")
    epoch_ns: int = Field(
        default=0, ge=0, description="CLOCK_MONOTONIC in ns at which the world's time is 0; the same for all units."
    )
    people: int = Field(default=1, ge=0, le=2, description="Number of people that walk beside the table.")
    seed: int = Field(default=0, ge=0, le=0xFFFF, description="Seed of the people's paths and of all noise.")
    knows_pose: bool = Field(
        default=True, description="Report the camera's pose; if false, the board or an operator gives it."
    )
    cell: Path | None = Field(default=None, description="A cell.yaml with a UR3e; the demo cell when left out.")

    @property
    def serial(self) -> str:
        """The camera's serial number."""
        return f"SIM{self.seed:05d}{self.camera:02d}"


class FrameObserver(Protocol):
    """Receives the camera and each of its frames, with the truth behind them.

    The source calls all methods on its own worker thread, one after the other.
    """

    def place(self, camera: SimulatedCamera) -> None:
        """Prepare for frames of `camera`: when the source opens, and each time the camera has moved.

        Raises:
            SourceError: the observer cannot work; the source does not open.
        """
        ...

    def observe(self, captured_at_ns: int, frame_number: int, frame: SimulatedFrame) -> None:
        """Take a frame that the source delivers. The source computes no further frame meanwhile."""
        ...

    def close(self) -> None:
        """Release what `place` acquired. `place` may follow again."""
        ...


class SimulatedImages:
    """Images of the board as the simulated camera takes them; an `ImageFeed`."""

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
        """See `ImageFeed`. The camera takes an image whenever the caller requests the next one."""
        loop = asyncio.get_running_loop()
        for number in itertools.count():
            now_ns = monotonic_ns()
            t_s = (now_ns - self._epoch_ns) / NS_PER_S
            yield ImageFrame(await loop.run_in_executor(self._worker, self._take, t_s), now_ns, number)

    def _take(self, t_s: float) -> NDArray[np.uint8]:
        image = self._camera.take(t_s)
        return np.zeros_like(image) if self._hands.now().covered else image


class SimulatedSource:
    """Renders a frame whenever one is due; a `DepthSource`."""

    def __init__(
        self, config: SimulatedSourceConfig, hands: Hands | None = None, observer: FrameObserver | None = None
    ) -> None:
        """Simulate the camera of `config`.

        `hands` knock, cover or exchange the camera while it runs; None leaves it alone. `observer` receives each frame.
        """
        self._config = config
        self._hands = hands
        self._observer = observer
        self._period_ns = round(NS_PER_S / config.fps)
        # The cameras of a real cell have no common trigger; here they take turns.
        self._first_ns = config.epoch_ns + self._period_ns * config.camera // config.cameras
        self._camera: SimulatedCamera | None = None
        self._handled: Handling | None = None
        self._T_world_place = identity()
        self._worker: ThreadPoolExecutor | None = None
        self._closing = asyncio.Event()

    async def open(self) -> CameraInfo:
        """See `DepthSource`."""
        self._closing.clear()
        # One thread: rendering and the observer never overlap.
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="simulated-camera")
        try:
            return await asyncio.get_running_loop().run_in_executor(self._worker, self._start)
        except BaseException:
            await self.close()
            raise

    async def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """See `DepthSource`. The capture time of a frame is its due time; rendering begins right after."""
        worker = self._worker
        if worker is None:
            raise SourceError("simulated camera: expected to be opened before its frames are read")
        loop = asyncio.get_running_loop()
        observing: asyncio.Future[None] | None = None
        number = -1
        while not self._closing.is_set():
            number = self._next_number(number, monotonic_ns())
            due_ns = self._first_ns + number * self._period_ns
            if await within((due_ns - monotonic_ns()) / NS_PER_S, self._closing.wait()):
                return
            frame = await loop.run_in_executor(worker, self._capture, due_ns)
            if observing is not None:
                await observing
            if self._observer is not None:
                observing = loop.run_in_executor(worker, self._observer.observe, due_ns, number, frame)
            yield DepthFrame(frame.depth, due_ns, number)

    @asynccontextmanager
    async def open_images(self, stream: ImageStream) -> AsyncIterator[SimulatedImages]:
        """See `ImageSource`."""
        worker = self._worker
        if worker is None:
            raise SourceError("simulated camera: expected to be opened before its images are read")
        camera = await asyncio.get_running_loop().run_in_executor(worker, self._board_camera, stream)
        assert self._hands is not None
        yield SimulatedImages(camera, self._hands, worker, self._config.epoch_ns)

    async def close(self) -> None:
        """See `DepthSource`."""
        self._closing.set()
        worker, self._worker = self._worker, None
        if worker is not None:
            await asyncio.get_running_loop().run_in_executor(worker, self._stop)
            worker.shutdown(wait=False)

    def _next_number(self, last: int, now_ns: int) -> int:
        """Return the number after `last`, or a later one if the reader is slow and more frames are due."""
        latest_due = (now_ns - self._first_ns) // self._period_ns
        return max(last + 1, latest_due if last >= 0 else latest_due + 1, 0)

    def _start(self) -> CameraInfo:
        """Build the world. Import the simulation only here: a unit may be installed without it."""
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
        except CellwatchError as error:
            raise SourceError(f"simulated camera: {error}") from error
        if self._hands is None:
            self._hands = Hands(None)
        handled = self._hands.now()
        self._hang(world, pose, intrinsics, handled)
        serial = handled.serial or config.serial
        return CameraInfo(serial, "Simulated D435i", intrinsics, pose if config.knows_pose else None)

    def _hang(self, world: World, T_world_place: Transform, intrinsics: Intrinsics, handled: Handling) -> None:
        """Hang the camera where the hands put it. The first frame compiles all kernels that the cache lacks."""
        from simulation.cameras.camera import SimulatedCamera

        config = self._config
        pose = T_world_place @ from_xyz_rpy(handled.xyz, np.radians(handled.rpy_deg))
        camera = SimulatedCamera(world, pose, intrinsics, seed=config.seed * 64 + config.camera)
        camera.capture(0.0)
        if self._observer is not None:
            self._observer.place(camera)
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
        if self._observer is not None:
            self._observer.close()
        self._camera = None

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
