# SPDX-License-Identifier: Apache-2.0
"""Detection of the calibration board in one image: its seen points, to a few hundredths of a pixel.

OpenCV finds the markers; the exact position of their corners decides the accuracy. A marker's corner is an L that blur
rounds off, which draws `cornerSubPix` inwards. The inner corners of a ChArUco board have no such bias, but few pixels
contribute to each. Here straight lines are fitted to each marker's four edges and intersected: symmetric blur does not
move the steepest point of an edge, and a line averages over all of its pixels. At 3 m the error of the camera's
position is a ninth of the error with `cornerSubPix` on markers, and less than half of the error with the inner corners
of ChArUco boards. So the markers of ChArUco boards are used like those of grids. OpenCV's AprilTag refinement also fits
lines, but takes half a second an image and finds no small markers.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_unit.calibration.board_layout import BORDER_CELLS, BoardLayout
from shared.camera import Intrinsics

EDGE_SAMPLES = 24
"""Along each edge of a marker."""

EDGE_ENDS = 0.12
"""Part of an edge at either end that is left out: there the corner's blur begins."""

PROFILE_STEP_PX = 0.25
PROFILE_REACH_PX = 3.0
MIN_REACH_PX = 1.0
QUIET = 0.8
"""Reach across an edge, to either side; less if the next edge, of code or square, is within this share of it."""

REFINEMENTS = 2
"""The second pass starts on the line of the first, so that its window lies symmetrically about the edge."""

MAX_SHIFT_PX = 2.5
"""The most that refinement may move a corner; beyond, the edges are not this marker's."""

SAME_PLACE_PX = 4.0
"""The largest distance of a point from the consensus of the others; beyond, its marker is not this board's."""

MIN_POINTS = 6
"""Four determine a homography; two more verify it."""

MIN_AGREEING = 0.75
"""Share of the points that must lie as on the board."""


@dataclass(frozen=True, eq=False)
class Detection:
    """Seen points of the board in one image.

    Attributes:
        points_m: (N, 3) seen points in the board's frame.
        pixels: (N, 2) their pixels in the image, undistorted.
        point_ids: (N,) their indices among the board's points.
        markers: number of the board's markers seen, in agreement with the board or not.
        marker_px: median edge of these, pixels.
        agreeing: share of the points that lie as on the board.
    """

    points_m: NDArray[np.float64]
    pixels: NDArray[np.float64]
    point_ids: NDArray[np.intp]
    markers: int
    marker_px: float
    agreeing: float

    @property
    def fits(self) -> bool:
        """True if a pose can be computed from it."""
        return len(self.points_m) >= MIN_POINTS and self.agreeing >= MIN_AGREEING


NOTHING = Detection(np.empty((0, 3)), np.empty((0, 2)), np.empty(0, dtype=np.intp), 0, 0.0, 1.0)


class BoardDetector:
    """Detects one board in the images of one lens."""

    def __init__(
        self,
        layout: BoardLayout,
        intrinsics: Intrinsics,
        distortion: tuple[float, ...] = (0.0,) * 5,
        distortion_model: str = "brown_conrady",
    ) -> None:
        """`distortion` is k1, k2, p1, p2, k3 of the SDK's `distortion_model`."""
        self.layout = layout
        self._lens = _Lens(intrinsics, np.array(distortion, dtype=np.float64), distortion_model)
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        # Wider windows reach the neighbouring corners of small markers.
        parameters.relativeCornerRefinmentWinSize = 0.3
        self._markers = cv2.aruco.ArucoDetector(layout.dictionary, parameters)
        board = layout.board
        cell_share = 1.0 / (layout.dictionary.markerSize + 2 * BORDER_CELLS)
        gap_m = board.square_m - board.marker_m
        gap_share = gap_m / board.marker_m * (0.5 if board.kind == "charuco" else 1.0)
        self._quiet_share = QUIET * min(cell_share, gap_share)

    def detect(self, image: NDArray[np.uint8]) -> Detection:
        """Detect the board in an image (H, W) grey or (H, W, 3) RGB; ignores other markers, and copies of its own."""
        grey: NDArray[np.uint8] = np.ascontiguousarray(
            image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8
        )
        corners, ids = self._own_markers(grey)
        if not len(ids):
            return NOTHING
        marker_px = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
        seen = len(np.unique(ids))
        points_m, pixels, point_ids = self._corners_of(grey, corners, ids)
        pixels = self._lens.rectified(pixels)
        if len(points_m) < MIN_POINTS:
            return Detection(points_m, pixels, point_ids, seen, marker_px, 1.0)
        _, inliers = cv2.findHomography(points_m[:, :2], pixels, cv2.RANSAC, SAME_PLACE_PX)
        # OpenCV returns None for degenerate points.
        flags = np.ravel(inliers)
        lie = flags.astype(bool) if len(flags) == len(points_m) else np.zeros(len(points_m), bool)
        agreeing = float(lie.mean())
        return Detection(points_m[lie], pixels[lie], point_ids[lie], seen, marker_px, agreeing)

    def _own_markers(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Return corners (K, 4, 2) and ids (K,) of the markers that belong to the board."""
        found, ids, _ = self._markers.detectMarkers(grey)
        if not len(found):
            return np.empty((0, 4, 2)), np.empty(0, dtype=np.intp)
        corners, numbers = np.array(found, dtype=np.float64).reshape(-1, 4, 2), np.ravel(ids).astype(np.intp)
        own = np.isin(numbers, self.layout.ids)
        return corners[own], numbers[own]

    def _corners_of(
        self, grey: NDArray[np.uint8], corners: NDArray[np.float64], ids: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.intp]]:
        """Return marker corners, refined by their edges."""
        refined = refined_corners(grey, corners, self._quiet_share)
        rows = ids - self.layout.ids[0]
        flat_m = self.layout.marker_corners_m[rows].reshape(-1, 2)
        points_m = np.column_stack((flat_m, np.zeros(len(flat_m))))
        point_ids = (4 * rows[:, None] + np.arange(4)).ravel()
        pixels = refined.reshape(-1, 2)
        good = np.isfinite(pixels).all(axis=1)
        return points_m[good], pixels[good], point_ids[good]


def refined_corners(grey: NDArray[np.uint8], corners: NDArray[np.float64], quiet_share: float) -> NDArray[np.float64]:
    """Return corners (K, 4, 2) of black markers on white: intersections of lines fitted to their edges; NaN on failure.

    `corners` go round each marker; `quiet_share`, of a marker's edge, is the width to either side of it that holds
    nothing but black and white.
    """
    refined = corners
    for _ in range(REFINEMENTS):
        refined = _intersections(*_edge_lines(grey, refined, quiet_share))
    far = np.linalg.norm(refined - corners, axis=2) > MAX_SHIFT_PX
    refined[far] = np.nan
    return refined


def _edge_lines(
    grey: NDArray[np.uint8], corners: NDArray[np.float64], quiet_share: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a point (K, 4, 2) and a direction (K, 4, 2) of the line along the edge from each corner to the next."""
    following = np.roll(corners, -1, axis=1)
    along = following - corners
    length = np.linalg.norm(along, axis=2, keepdims=True)
    direction = along / np.maximum(length, 1e-9)
    middle = corners.mean(axis=1, keepdims=True)
    normal = np.stack((direction[..., 1], -direction[..., 0]), axis=-1)
    outward = np.sign(np.sum(normal * (0.5 * (corners + following) - middle), axis=2, keepdims=True))
    normal *= outward
    reach = np.clip(quiet_share * length, MIN_REACH_PX, PROFILE_REACH_PX)
    steps = np.arange(-1.0, 1.0 + 1e-9, PROFILE_STEP_PX / PROFILE_REACH_PX)
    shares = np.linspace(EDGE_ENDS, 1.0 - EDGE_ENDS, EDGE_SAMPLES)
    on_edge = corners[:, :, None] + shares[:, None] * along[:, :, None]
    offsets = steps * reach
    samples = on_edge[:, :, :, None] + offsets[:, :, None, :, None] * normal[:, :, None, None]
    values = cv2.remap(
        grey.astype(np.float32),
        samples[..., 0].reshape(-1, len(steps)).astype(np.float32),
        samples[..., 1].reshape(-1, len(steps)).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).reshape(samples.shape[:-1])
    # Black inside, white outside: the edge is the outward rise; its centroid is the steepest point.
    rise = np.diff(values, axis=3)
    middles = 0.5 * (offsets[..., 1:] + offsets[..., :-1])[:, :, None]
    weight = np.maximum(rise, 0.0)
    total = weight.sum(axis=3)
    offset = np.sum(weight * middles, axis=3) / np.maximum(total, 1e-9)
    seen = on_edge + offset[..., None] * normal[:, :, None]
    # Total least squares; each sample is weighted by the strength of its edge.
    share = total / np.maximum(total.sum(axis=2, keepdims=True), 1e-9)
    centre = np.sum(share[..., None] * seen, axis=2)
    off = seen - centre[:, :, None]
    scatter = np.einsum("kes,kesi,kesj->keij", share, off, off)
    _, vectors = np.linalg.eigh(scatter)
    return centre, vectors[..., 1]


def _intersections(centre: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the intersections of each edge's line with the line of the edge before: the corners (K, 4, 2)."""
    before, before_direction = np.roll(centre, 1, axis=1), np.roll(direction, 1, axis=1)
    cross = before_direction[..., 0] * direction[..., 1] - before_direction[..., 1] * direction[..., 0]
    gap = centre - before
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (gap[..., 0] * direction[..., 1] - gap[..., 1] * direction[..., 0]) / cross
        return np.asarray(before + along[..., None] * before_direction)


@dataclass(frozen=True, eq=False)
class _Lens:
    """Removes a lens's distortion from pixels."""

    intrinsics: Intrinsics
    distortion: NDArray[np.float64]
    model: str

    def rectified(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the undistorted positions (N, 2) of the points."""
        if not self.distortion.any() or not len(pixels):
            return pixels
        camera = self.intrinsics
        matrix = np.array(((camera.fx, 0.0, camera.cx), (0.0, camera.fy, camera.cy), (0.0, 0.0, 1.0)))
        if "inverse" not in self.model:
            return cv2.undistortPoints(pixels[:, None], matrix, self.distortion, P=matrix)[:, 0].astype(np.float64)
        # The SDK's inverse model is the polynomial from the image to the ray, so nothing is inverted here.
        k1, k2, p1, p2, k3 = self.distortion
        x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        ray_x = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        ray_y = y * radial + 2.0 * p2 * x * y + p1 * (square + 2.0 * y * y)
        return np.column_stack((ray_x * camera.fx + camera.cx, ray_y * camera.fy + camera.cy))
