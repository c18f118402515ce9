# SPDX-License-Identifier: Apache-2.0
"""A frame, a camera's identity, and what every source can do."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shared.camera import Intrinsics
from shared.transforms import Transform


@dataclass(frozen=True)
class DepthFrame:
    """One depth image.

    `depth` (H, W) uint16 in units of `depth_scale_m`, 0 where nothing was measured; it may lie in memory that the
    source uses again, so copy what is to be kept beyond the next frame. `captured_at_ns` is CLOCK_MONOTONIC of this
    unit at the middle of the exposure. `frame_number` rises; a gap means that frames were dropped. `joints` (n,) rad
    only where a data set carries them.
    """

    depth: NDArray[np.uint16]
    captured_at_ns: int
    frame_number: int
    joints: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class CameraInfo:
    """Who the camera is: `serial` tells it from all others; `T_world_camera` only where the source knows its pose."""

    serial: str
    model: str
    intrinsics: Intrinsics
    T_world_camera: Transform | None = None


class DepthSource(Protocol):
    """A camera, real or not. `open`, then `frames`, then `close`; after `close` it may be opened again."""

    async def open(self) -> CameraInfo:
        """Start the camera.

        Raises:
            SourceError: it is not there, or does not start; the text says what to do.
        """
        ...

    def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """Frames as they come, latest wins: a slow reader skips, it never lags. Ends where a recording ends.

        Raises:
            SourceError: the camera stopped delivering.
        """
        ...

    async def close(self) -> None:
        """Stop the camera and release it; harmless when it is not open."""
        ...
