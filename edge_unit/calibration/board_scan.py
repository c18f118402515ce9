# SPDX-License-Identifier: Apache-2.0
"""Searches for the board in a source's own images: once on command, or repeatedly with growing pauses."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import aclosing

from edge_unit.calibration.board_pose import BoardLocaliser, Localisation
from edge_unit.sources.image import ImageSource, ImageStream
from shared.cell import Board
from shared.clock import NS_PER_S
from shared.errors import BoardError, SourceError
from shared.waiting import LOOP_CLOCK, Clock

FRAMES = 20
"""Images of which most show the board: more would not help the mean, as their common error does not average out."""

GOOD_FRAMES = 8
GOOD_MM, GOOD_DEG = 5.0, 0.1
"""So many images that agree on a pose known this well are enough: no margin of the filter is that narrow."""

EMPTY_FRAMES = 15
"""Images without any marker after which there is no board; in one image a person may hide it."""

MAX_LOOK_S = 20.0
"""Time for images that show only some of it; then the pose is computed from these."""

RETRY_MIN_S = 2.0
RETRY_MAX_S = 30.0
"""Pauses between two searches: a mounted board is found within them, and depth is interrupted no more often."""


class BoardSearch:
    """One unit's search for its cell's board."""

    def __init__(self, source: object, stream: ImageStream, clock: Clock = LOOP_CLOCK) -> None:
        """Without an `ImageSource` as `source` there are no images to search."""
        self._clock = clock
        self._source = source
        self._stream: ImageStream = stream
        self._retry_s = RETRY_MIN_S
        self._next_ns = 0
        self.outcome = ""

    @property
    def possible(self) -> bool:
        """True if the source has images at all."""
        return isinstance(self._source, ImageSource)

    @property
    def due(self) -> bool:
        """True if it is time for another search."""
        return self.possible and self._clock.now_ns() >= self._next_ns

    def begin_anew(self) -> None:
        """Search at once, and with short pauses again."""
        self._next_ns, self._retry_s = 0, RETRY_MIN_S

    async def scan(self, board: Board, tell: Callable[[str, int], None]) -> Localisation:
        """Take images until they give the pose, or will not.

        `tell` receives, after each image, a sentence and the number of images that gave a pose, of `FRAMES`.

        Raises:
            BoardError: the images do not give a pose; one sentence with the remedy.
            CellError: OpenCV has no such board.
            SourceError: the camera delivers no images.
        """
        source = self._source
        if not isinstance(source, ImageSource):
            raise BoardError("this unit's source has no images in which to look for the board")
        begun_ns = self._clock.now_ns()
        try:
            async with source.open_images(self._stream) as feed:
                info = feed.info
                localiser = BoardLocaliser(
                    board, info.intrinsics, info.distortion, info.T_depth_image, info.distortion_model
                )
                seen, empty = 0, 0
                async with aclosing(feed.images()) as images:
                    async for image in images:
                        sighting = await asyncio.to_thread(localiser.add, image.pixels.copy())
                        tell(f"searching for the board: {localiser.now}", localiser.frames_with_pose)
                        seen += 1
                        empty = 0 if sighting.detection.markers else empty + 1
                        late = self._clock.now_ns() - begun_ns > MAX_LOOK_S * NS_PER_S
                        if late or empty >= EMPTY_FRAMES or localiser.frames_with_pose >= FRAMES:
                            break
                        if await asyncio.to_thread(_is_good, localiser):
                            break
                if not seen:
                    raise SourceError("the camera delivered no image to look for the board in")
                found = await asyncio.to_thread(localiser.result)
        except (BoardError, SourceError) as error:
            self.outcome = str(error)
            self._next_ns = self._clock.now_ns() + round(self._retry_s * NS_PER_S)
            self._retry_s = min(2.0 * self._retry_s, RETRY_MAX_S)
            raise
        self.outcome = ""
        self.begin_anew()
        return found


def _is_good(localiser: BoardLocaliser) -> bool:
    """Return True if the pose is known so well that more images are not worth the time."""
    if localiser.frames_with_pose < GOOD_FRAMES:
        return False
    try:
        found = localiser.result()
    except BoardError:
        return False
    return found.uncertainty_mm <= GOOD_MM and found.uncertainty_deg <= GOOD_DEG
