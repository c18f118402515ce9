# SPDX-License-Identifier: Apache-2.0
"""Images other than depth, for the calibration board, with their geometry relative to the depth image."""

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
"""`infrared` is the left imager, the frame of the depth image; `color` has a lens and a pose of its own."""


@dataclass(frozen=True)
class ImageInfo:
    """The lens of an image stream, and its pose.

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
    """One image: `pixels` (H, W) uint8 for infrared, (H, W, 3) uint8 RGB for colour.

    Valid until the next one is delivered; copy it to keep it. `captured_at_ns` is CLOCK_MONOTONIC.
    """

    pixels: NDArray[np.uint8]
    captured_at_ns: int
    frame_number: int


class ImageFeed(Protocol):
    """Images of one stream, while depth is paused."""

    @property
    def info(self) -> ImageInfo:
        """The stream's lens and pose."""
        ...

    def images(self) -> AsyncGenerator[ImageFrame, None]:
        """Yield images as they come, latest-only.

        Raises:
            SourceError: the camera will deliver no more.
        """
        ...


@runtime_checkable
class ImageSource(Protocol):
    """A source that can deliver images of another stream, with the emitter off, within the context."""

    def open_images(self, stream: ImageStream) -> AbstractAsyncContextManager[ImageFeed]:
        """Pause depth and deliver images; depth resumes at the end of the context.

        Raises:
            SourceError: the source is not open, or has no such stream.
        """
        ...
