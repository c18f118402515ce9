# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks.latency_probe.unit CONFIG.YAML RING.NPY`: the edge unit with a camera that plays frames.

All but the source is the installed daemon. `benchmarks.latency_probe.frames` renders the ring beforehand. The capture
time of a frame is its due time.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncGenerator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.latency_probe.frames import RING_HZ, camera_phase_s
from edge_unit.__main__ import main
from edge_unit.sources.frame import CameraInfo, DepthFrame
from edge_unit.sources.simulated import SimulatedSourceConfig
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import SourceError
from simulation.cameras.camera import d435i_intrinsics, rig
from simulation.world.world import World


class RingSource:
    """Plays a ring of frames at the pace of the configuration, from the epoch on; a `DepthSource`."""

    def __init__(self, config: SimulatedSourceConfig, ring: Path) -> None:
        self._config = config
        self._ring = ring
        self._frames: NDArray[np.uint16] | None = None

    async def open(self) -> CameraInfo:
        """See `DepthSource`."""
        # All frames are in memory, because a disk would be part of the measurement.
        self._frames = await asyncio.to_thread(np.load, self._ring)
        config = self._config
        pose = rig(World.demo(people=0).cell, config.cameras)[config.camera]
        return CameraInfo(config.serial, "Played D435i", d435i_intrinsics(config.width, config.height), pose)

    async def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """See `DepthSource`. A slow consumer skips frames."""
        frames, config = self._frames, self._config
        if frames is None:
            raise SourceError("played camera: expected open() before frames(); call it first")
        period_ns = round(NS_PER_S / config.fps)
        stride = round(RING_HZ / config.fps)
        first_ns = config.epoch_ns + round(camera_phase_s(config.camera, config.cameras) * NS_PER_S)
        last = -1
        while True:
            latest = (monotonic_ns() - first_ns) // period_ns
            # The frame that was taken while the consumer was busy, or else the next one.
            last = latest if latest > last >= 0 else max(latest, last) + 1
            due_ns = first_ns + last * period_ns
            await asyncio.sleep(max(due_ns - monotonic_ns(), 0) / NS_PER_S)
            yield DepthFrame(frames[last * stride % len(frames)], due_ns, last)

    async def close(self) -> None:
        """See `DepthSource`."""
        self._frames = None


if __name__ == "__main__":
    config_path, ring_path = sys.argv[1:]
    arguments = ["run", config_path, "--log-level", "WARNING"]
    sys.exit(main(arguments, {SimulatedSourceConfig: partial(RingSource, ring=Path(ring_path))}))
