# SPDX-License-Identifier: Apache-2.0
"""Images of the calibration board in a camera: perspective, antialiased, blurred, with noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_unit.calibration.board_layout import BoardLayout
from edge_unit.sources.image import ImageStream
from shared.camera import Intrinsics
from shared.transforms import Transform, apply, from_xyz_rpy, identity, inverse
from simulation.cameras.raster import RasterRenderer
from simulation.world.world import World

TEXTURE_PX_PER_M = 8000.0
TEXTURE_MAX_PX = 6000
"""A board is drawn once at 0.125 mm a pixel, with exact grey at its edges; coarser if it is large."""

TEXTURE_PX_A_RAY = 1.5
"""Least number of texture pixels for each ray, so that no texture between two rays is lost."""

SUPERSAMPLING = 4
"""Rays along each side of a pixel."""

THICKNESS_M = 0.005
"""Least distance before the board at which an object hides it, since a board lies on a surface."""

MARGIN_SQUARES = 0.5
"""White paper around the pattern."""


@dataclass(frozen=True)
class PictureQuality:
    """Grey values 0 to 255 before noise; `blur_px` and `noise` are standard deviations."""

    white: float = 200.0
    black: float = 25.0
    surroundings: float = 105.0
    blur_px: float = 0.6
    noise: float = 2.0


class BoardPicture:
    """Draw one board in the image of one camera."""

    def __init__(
        self,
        layout: BoardLayout,
        intrinsics: Intrinsics,
        quality: PictureQuality | None = None,
        px_per_m: float = TEXTURE_PX_PER_M,
    ) -> None:
        """Draw the board's texture, at most at `px_per_m`; a board that is far away needs less."""
        self._intrinsics = intrinsics
        self._quality = quality or PictureQuality()
        self._margin_m = MARGIN_SQUARES * layout.board.square_m
        width_m, height_m = (side + 2.0 * self._margin_m for side in layout.size_m)
        self._size_m = width_m, height_m
        self._px_per_m = min(px_per_m, TEXTURE_PX_PER_M, TEXTURE_MAX_PX / max(width_m, height_m))
        self._texture = self._drawn(layout)

    def part(self, T_camera_board: Transform) -> tuple[slice, slice] | None:
        """Return the rows and columns that contain the board, or None if it is not in view or seen from behind."""
        camera = self._intrinsics
        (width_m, height_m), margin_m = self._size_m, self._margin_m
        outline_m = np.array(((0, 0, 0), (width_m, 0, 0), (width_m, height_m, 0), (0, height_m, 0))) - (
            margin_m,
            margin_m,
            0.0,
        )
        corners = apply(T_camera_board, outline_m)
        eye_m = inverse(T_camera_board)[:3, 3]
        if corners[:, 2].min() < 0.05 or eye_m[2] >= 0.0:
            return None
        pixels = camera.project(corners)
        left, top = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 4, 0).tolist()
        right, bottom = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 5, (camera.width, camera.height)).tolist()
        return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None

    def expose(self, T_camera_board: Transform, hidden: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Return the image (H, W) float32 without noise; `hidden` (H, W) pixels and the back do not show the board."""
        camera, quality, margin_m = self._intrinsics, self._quality, self._margin_m
        image = np.full(camera.shape, quality.surroundings, dtype=np.float32)
        seen_in = self.part(T_camera_board)
        if seen_in is None:
            return image
        part = image[seen_in]
        height, width = part.shape
        s, top, left = float(SUPERSAMPLING), seen_in[0].start, seen_in[1].start
        # A pixel's centre is at integer coordinates, on either grid.
        fine_of_pixel = np.array(
            ((s, 0.0, 0.5 * (s - 1.0) - s * left), (0.0, s, 0.5 * (s - 1.0) - s * top), (0.0, 0.0, 1.0))
        )
        pixel_of_camera = np.array(((camera.fx, 0.0, camera.cx), (0.0, camera.fy, camera.cy), (0.0, 0.0, 1.0)))
        step_m = 1.0 / self._px_per_m
        board_of_texture = np.array(
            ((step_m, 0.0, 0.5 * step_m - margin_m), (0.0, step_m, 0.5 * step_m - margin_m), (0.0, 0.0, 1.0))
        )
        camera_of_board = T_camera_board[:3][:, [0, 1, 3]]
        homography = fine_of_pixel @ pixel_of_camera @ camera_of_board @ board_of_texture
        fine = cv2.warpPerspective(
            self._texture,
            homography,
            (width * SUPERSAMPLING, height * SUPERSAMPLING),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=quality.surroundings,
        )
        np.copyto(part, cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA))
        if hidden is not None:
            image[hidden] = quality.surroundings
        if quality.blur_px > 0.0:
            # Beyond the board the image is uniformly grey, so its surroundings need no blur.
            part[:] = cv2.GaussianBlur(part, (0, 0), quality.blur_px)
        return image

    def develop(self, exposed: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the image as a frame (H, W) uint8, with new noise."""
        noise = rng.standard_normal(exposed.shape, dtype=np.float32) * np.float32(self._quality.noise)
        return np.asarray(np.clip(exposed + noise + 0.5, 0.0, 255.0), dtype=np.uint8)

    def _drawn(self, layout: BoardLayout) -> NDArray[np.float32]:
        """Draw the board with its margin, (H, W) float32; each pixel is the mean of the area that it covers."""
        px = self._px_per_m
        width, height = (round(side * px) for side in self._size_m)
        black = np.zeros((height, width), dtype=np.float32)
        for x0, y0, x1, y1 in (layout.black_m + self._margin_m) * px:
            columns, across = _covered(x0, x1)
            rows, down = _covered(y0, y1)
            black[rows, columns] += np.outer(down, across)
        quality = self._quality
        return np.asarray(quality.white + (quality.black - quality.white) * black, dtype=np.float32)


def _covered(low: float, high: float) -> tuple[slice, NDArray[np.float32]]:
    """Return the pixels that an interval touches, and the covered share of each."""
    first, last = int(np.floor(low)), int(np.ceil(high))
    edges = np.arange(first, last + 1)
    covered = np.diff(np.clip(edges, low, high)).astype(np.float32)
    return slice(first, last), covered


class BoardCamera:
    """An image stream of a fixed depth camera in a world with a board, with its emitter off."""

    def __init__(self, world: World, T_world_depth: Transform, stream: ImageStream, seed: int) -> None:
        """Prepare the stream; the image of a cell without a board is grey."""
        focal_px, T_depth_image = _STREAMS[stream]
        self.stream: ImageStream = stream
        self.T_depth_image = T_depth_image
        self.intrinsics = Intrinsics(1280, 720, focal_px, focal_px, 639.5, 359.5)
        self._world = world
        self._rng = np.random.default_rng((seed, 0xB0A4))
        T_world_image = T_world_depth @ T_depth_image
        board = world.cell.board
        self._picture: BoardPicture | None = None
        self._T_image_board: Transform | None = None
        if board is not None:
            self._T_image_board = inverse(T_world_image) @ board.T_world_board
            layout = BoardLayout.of(board)
            nearest_m = float(np.linalg.norm(self._T_image_board[:3, 3])) - float(np.hypot(*layout.size_m))
            px_per_m = TEXTURE_PX_A_RAY * SUPERSAMPLING * focal_px / max(nearest_m, 0.1)
            self._picture = BoardPicture(layout, self.intrinsics, px_per_m=px_per_m)
        # Other objects in the image are not drawn.
        self._part: tuple[slice, slice] | None = None
        if self._picture is not None and self._T_image_board is not None:
            self._part = self._picture.part(self._T_image_board)
        if self._part is not None and self._T_image_board is not None:
            part = _cut_out(self.intrinsics, self._part)
            self._renderer = RasterRenderer(part, T_world_image)
            self._hiding_z_m = _plane_z_m(part, self._T_image_board) - THICKNESS_M

    def take(self, t_s: float) -> NDArray[np.uint8]:
        """Return the image (720, 1280) uint8 taken at `t_s`, RGB for colour; objects before the board hide it."""
        picture, T_image_board = self._picture, self._T_image_board
        if picture is None or T_image_board is None:
            return np.full(self.intrinsics.shape, round(PictureQuality().surroundings), np.uint8)
        hidden = np.zeros(self.intrinsics.shape, np.bool_)
        if self._part is not None:
            hidden[self._part] = self._renderer.render(self._world.scene(t_s)).z_m < self._hiding_z_m
        grey = picture.develop(picture.expose(T_image_board, hidden), self._rng)
        return grey if self.stream == "infrared" else np.repeat(grey[:, :, None], 3, axis=2)


def _cut_out(camera: Intrinsics, part: tuple[slice, slice]) -> Intrinsics:
    """Return the intrinsics of a part of the image."""
    rows, columns = part
    height, width = rows.stop - rows.start, columns.stop - columns.start
    return Intrinsics(width, height, camera.fx, camera.fy, camera.cx - columns.start, camera.cy - rows.start)


def _plane_z_m(camera: Intrinsics, T_image_board: Transform) -> NDArray[np.float64]:
    """Return the depth (H, W) at which each pixel's ray meets the board's plane; arbitrary if it does not."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    normal, origin_m = T_image_board[:3, 2], T_image_board[:3, 3]
    along = normal[0] * (u - camera.cx) / camera.fx + normal[1] * (v - camera.cy) / camera.fy + normal[2]
    with np.errstate(divide="ignore"):
        return np.asarray(normal @ origin_m / along)


_STREAMS: dict[ImageStream, tuple[float, Transform]] = {
    "infrared": (640.0, identity()),
    "color": (915.0, from_xyz_rpy((0.015, 0.0, 0.0), (0.002, -0.001, 0.003))),
}
