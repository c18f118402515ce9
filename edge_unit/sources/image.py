# SPDX-License-Identifier: Apache-2.0
"""A picture that is not depth: what finds the calibration board, and how it lies to the depth image."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from shared.camera import Intrinsics
from shared.transforms import Transform

ImageStream = Literal["infrared", "color"]
"""`infrared` is the left imager, in which the depth image lies; `color` has a lens and a place of its own."""


@dataclass(frozen=True)
class ImageInfo:
    """The lens of an image stream, and where it stands.

    `distortion` (5,) is k1, k2, p1, p2, k3 of `distortion_model`; all zero for a rectified image. `T_depth_image` maps
    points of this stream's optical frame into the depth camera's.
    """

    stream: ImageStream
    intrinsics: Intrinsics
    distortion: tuple[float, float, float, float, float]
    distortion_model: str
    T_depth_image: Transform


@dataclass(frozen=True)
class ImageFrame:
    """One picture: `pixels` (H, W) uint8 for infrared, (H, W, 3) uint8 RGB for colour.

    Valid until the next one is delivered; copy what is to be kept. `captured_at_ns` is CLOCK_MONOTONIC.
    """

    pixels: NDArray[np.uint8]
    captured_at_ns: int
    frame_number: int


class ImageFeed(Protocol):
    """Pictures of one image stream, while depth pauses."""

    @property
    def info(self) -> ImageInfo:
        """The stream's lens, and where it stands."""
        ...

    def images(self) -> AsyncGenerator[ImageFrame, None]:
        """Pictures as they come, latest wins.

        Raises:
            SourceError: the camera will deliver no more.
        """
        ...


@runtime_checkable
class ImageSource(Protocol):
    """A source that can deliver pictures of another stream, the emitter off, for as long as the context lasts."""

    def look(self, stream: ImageStream) -> AbstractAsyncContextManager[ImageFeed]:
        """Pause depth and begin; depth goes on afterwards by itself.

        Raises:
            SourceError: it is not open, or has no such stream.
        """
        ...
