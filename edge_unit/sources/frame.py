# SPDX-License-Identifier: Apache-2.0
"""A frame, a camera's identity, and the interface of every source."""

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

    `depth` (H, W) uint16 in units of `depth_scale_m`, 0 where nothing was measured. The source may reuse its memory:
    copy it to keep it beyond the next frame. `captured_at_ns` is CLOCK_MONOTONIC of this unit at the middle of the
    exposure. `frame_number` rises; a gap means that frames were dropped. `joints` (n,) rad only if a data set carries
    them.
    """

    depth: NDArray[np.uint16]
    captured_at_ns: int
    frame_number: int
    joints: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class CameraInfo:
    """A camera's identity: `serial` is unique; `T_world_camera` only if the source knows its pose."""

    serial: str
    model: str
    intrinsics: Intrinsics
    T_world_camera: Transform | None = None


class DepthSource(Protocol):
    """A camera, real or not. `open`, then `frames`, then `close`; after `close` it may be opened again."""

    async def open(self) -> CameraInfo:
        """Start the camera.

        Raises:
            SourceError: it is absent, or does not start; the text says what to do.
        """
        ...

    def frames(self) -> AsyncGenerator[DepthFrame, None]:
        """Yield frames as they come, latest-only: a slow reader skips frames, and never lags. Ends with a recording.

        Raises:
            SourceError: the camera stopped delivering.
        """
        ...

    async def close(self) -> None:
        """Stop the camera and release it; no effect if it is not open."""
        ...
