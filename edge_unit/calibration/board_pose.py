# SPDX-License-Identifier: Apache-2.0
"""The camera's pose from images of the calibration board, or one sentence that says what to do.

Each image gives a pose (IPPE, then Levenberg-Marquardt). Both solutions for a flat board are refined, and the better
one counts if it is better by enough. Many images give a mean. Its uncertainty has two parts. Noise that differs from
image to image averages out. An error that all images share (the edges fall on the same pixels while nothing moves) does
not; it is estimated from the reprojection error of the points. A wrongly measured board or wrong intrinsics add an
error that no image of the board can show.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_unit.calibration.board_detection import MIN_AGREEING, BoardDetector, Detection
from edge_unit.calibration.board_layout import BoardLayout
from edge_unit.calibration.pose_average import PoseMean, mean_pose
from shared.camera import Intrinsics
from shared.cell import Board
from shared.errors import BoardError
from shared.transforms import Transform, angle_rad, from_rotation_translation, identity, inverse

MIN_FRAMES = 5
"""Images with a pose. Fewer say nothing of their own spread."""

MAX_FRAMES = 120
"""Images kept at a time: eight seconds at 15 fps."""

MIN_AGREEING_FRAMES = 0.75
"""Share of the frames with a pose that must agree on it; a camera that is pushed meanwhile has two poses."""

MIN_MARKERS = 3
"""Markers needed, unless the board has fewer."""

MIN_MARKER_PX = 10.0
"""A marker of 7 cells is not read reliably below."""

MAX_TILT_DEG = 70.0
"""Angle of the board's normal to the line of sight; beyond, an edge is a third of its length."""

MAX_REPROJECTION_PX = 0.8
"""RMS. A board that matches its description gives 0.1 to 0.3."""

AMBIGUOUS_RATIO = 1.3
AMBIGUOUS_DEG = 3.0
"""Two poses this far apart that fit almost equally well are ambiguous."""

MAX_SPREAD_M = 0.010
MAX_SPREAD_SIGMA = 5.0
"""Spread of single positions: beyond this, and beyond so many times the image noise, something moved."""

MAX_UNCERTAINTY_M = 0.030
MAX_UNCERTAINTY_DEG = 1.0
"""A pose worse than this makes false voxels at every wall."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """One image: its detection and, if the detection gives one, the pose.

    `T_board_image` is None without a pose; `covariance` (6, 6) of its position (board's frame, m) and rotation (image
    frame, rad); `tilt_deg` of the board to the line of sight.
    """

    detection: Detection
    T_board_image: Transform | None = None
    covariance: NDArray[np.float64] | None = None
    reprojection_px: float = 0.0
    tilt_deg: float = 0.0
    ambiguous: bool = False


@dataclass(frozen=True, eq=False)
class Localisation:
    """The camera's pose, with its uncertainty.

    Attributes:
        T_world_camera: (4, 4), the depth camera's optical frame.
        uncertainty_mm, uncertainty_deg: standard error of position and rotation, all axes together.
        reprojection_px: RMS distance from the points to their positions by the pose, median of the frames.
        frames_used, frames_seen: frames in the mean, and all frames examined.
        markers, markers_total: median number seen in a frame, and the board's number.
    """

    T_world_camera: Transform
    uncertainty_mm: float
    uncertainty_deg: float
    reprojection_px: float
    frames_used: int
    frames_seen: int
    markers: int
    markers_total: int


class BoardLocaliser:
    """Collects images of one still camera until its pose is known."""

    def __init__(
        self,
        board: Board,
        intrinsics: Intrinsics,
        distortion: tuple[float, ...] = (0.0,) * 5,
        T_depth_image: Transform | None = None,
        distortion_model: str = "brown_conrady",
    ) -> None:
        """Intrinsics and distortion (k1, k2, p1, p2, k3) of the image stream, at `T_depth_image` from the depth camera.

        Raises:
            CellError: OpenCV has no such board.
        """
        layout = BoardLayout.of(board)
        self._detector = BoardDetector(layout, intrinsics, distortion, distortion_model)
        self._intrinsics = intrinsics
        self._T_world_board = board.T_world_board
        self._T_image_depth = inverse(identity() if T_depth_image is None else T_depth_image)
        self._sightings: list[Sighting] = []
        self._markers_total = len(layout.ids)

    def add(self, image: NDArray[np.uint8]) -> Sighting:
        """Add an image (H, W) grey or (H, W, 3) RGB, uint8."""
        sighting = _sighting(self._detector.detect(image), self._intrinsics)
        self._sightings.append(sighting)
        del self._sightings[:-MAX_FRAMES]
        return sighting

    @property
    def frames_with_pose(self) -> int:
        """Number of images so far that give a pose."""
        return len(self._posed)

    @property
    def _posed(self) -> list[Sighting]:
        least = min(MIN_MARKERS, self._markers_total)
        return [
            sighting
            for sighting in self._sightings
            if sighting.T_board_image is not None and sighting.detection.markers >= least
        ]

    def clear(self) -> None:
        """Remove all images."""
        self._sightings.clear()

    @property
    def now(self) -> str:
        """Describe the last image in a few words."""
        markers = self._sightings[-1].detection.markers if self._sightings else 0
        return f"{markers} of {self._markers_total} markers"

    def result(self) -> Localisation:
        """Return the pose from all images.

        Raises:
            BoardError: they do not give it; one sentence with the reason and the remedy.
        """
        seen = self._sightings
        posed = self._posed
        self._check_sight(posed)
        mean = mean_pose(np.array([sighting.T_board_image for sighting in posed]))
        used = [sighting for sighting, good in zip(posed, mean.used, strict=True) if good]
        common = np.median([sighting.covariance for sighting in used], axis=0)
        _check_agreement(mean, common, len(posed))
        total = mean.covariance + common
        uncertainty_m = float(np.sqrt(np.trace(total[:3, :3])))
        uncertainty_deg = float(np.degrees(np.sqrt(np.trace(total[3:, 3:]))))
        if uncertainty_m > MAX_UNCERTAINTY_M or uncertainty_deg > MAX_UNCERTAINTY_DEG:
            raise BoardError(
                f"the pose is known to {1e3 * uncertainty_m:.0f} mm and {uncertainty_deg:.1f} degrees only: "
                "bring the board nearer, turn it by 20 to 40 degrees, or print it larger"
            )
        T_world_camera = self._T_world_board @ mean.pose @ self._T_image_depth
        reprojection_px = float(np.median([sighting.reprojection_px for sighting in used]))
        return Localisation(
            T_world_camera,
            1e3 * uncertainty_m,
            uncertainty_deg,
            reprojection_px,
            len(used),
            len(seen),
            int(np.median([sighting.detection.markers for sighting in used])),
            self._markers_total,
        )

    def _check_sight(self, posed: list[Sighting]) -> None:
        """Raise BoardError if the board is not seen well enough."""
        total, seen = self._markers_total, self._sightings
        if not any(sighting.detection.markers for sighting in seen):
            raise BoardError(
                f"none of the board's {total} markers was seen in {len(seen)} images: bring the printed board of "
                "this cell into view, lit and unhidden"
            )
        detections = [sighting.detection for sighting in seen if sighting.detection.markers]
        marker_px = float(np.median([detection.marker_px for detection in detections]))
        if marker_px < MIN_MARKER_PX:
            raise BoardError(
                f"the markers are {marker_px:.0f} pixels wide, expected at least {MIN_MARKER_PX:.0f}: bring the board "
                "nearer, print it larger, or choose a stream of more pixels"
            )
        if float(np.median([detection.agreeing for detection in detections])) < MIN_AGREEING:
            raise BoardError(
                "the markers do not lie as on this cell's board: compare the printed board with `board` in cell.yaml, "
                "and take other markers of its dictionary out of view"
            )
        markers = int(np.median([sighting.detection.markers for sighting in seen]))
        if len(posed) < MIN_FRAMES:
            raise BoardError(
                f"{markers} of {total} markers were seen, and a pose in {len(posed)} of {len(seen)} images, expected "
                f"{min(MIN_MARKERS, total)} markers in {MIN_FRAMES} images: take away what hides the board, light it"
            )
        reprojection_px = float(np.median([sighting.reprojection_px for sighting in posed]))
        if reprojection_px > MAX_REPROJECTION_PX:
            raise BoardError(
                f"the markers are {reprojection_px:.1f} pixels off where this cell's board would have them: measure "
                "the printed board (square_m, marker_m), and see that it is flat"
            )
        tilt_deg = float(np.median([sighting.tilt_deg for sighting in posed]))
        if tilt_deg > MAX_TILT_DEG:
            raise BoardError(
                f"the board is seen at {tilt_deg:.0f} degrees from straight on, expected at most {MAX_TILT_DEG:.0f}: "
                "turn it towards the camera"
            )
        if 2 * sum(sighting.ambiguous for sighting in posed) > len(posed):
            raise BoardError(
                "two poses fit the images alike: bring the board nearer, or turn it by 20 to 40 degrees from "
                "straight on"
            )


def _check_agreement(mean: PoseMean, common: NDArray[np.float64], posed: int) -> None:
    """Raise BoardError if the camera or the board moved."""
    used = int(mean.used.sum())
    expected_m = float(np.sqrt(np.trace(common[:3, :3])))
    if used < MIN_AGREEING_FRAMES * posed:
        raise BoardError(
            f"only {used} of {posed} images agree on a pose: see that neither camera nor board moves, and try again"
        )
    if mean.spread_m > max(MAX_SPREAD_M, MAX_SPREAD_SIGMA * expected_m):
        raise BoardError(
            f"the pose varies by {1e3 * mean.spread_m:.0f} mm from image to image: see that neither camera nor "
            "board moves, and try again"
        )


def _sighting(detection: Detection, camera: Intrinsics) -> Sighting:
    """Return a detection with its pose, if it gives one."""
    if not detection.fits:
        return Sighting(detection)
    matrix = np.array(((camera.fx, 0.0, camera.cx), (0.0, camera.fy, camera.cy), (0.0, 0.0, 1.0)))
    points_m, pixels = detection.points_m, detection.pixels
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(points_m, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
        solutions = [
            cv2.solvePnPRefineLM(points_m, pixels, matrix, None, rotation, translation)
            for rotation, translation in zip(rotations, translations, strict=True)
        ]
    except cv2.error:
        # Points on one line, or so close to one line that there is no homography.
        return Sighting(detection)
    fits = []
    for rotation, translation in solutions:
        T_image_board = from_rotation_translation(cv2.Rodrigues(rotation)[0], translation.ravel())
        in_camera_m = points_m @ T_image_board[:3, :3].T + T_image_board[:3, 3]
        if in_camera_m[:, 2].min() <= 0.0 or not np.isfinite(T_image_board).all():
            continue
        residuals = camera.project(in_camera_m) - pixels
        fits.append((float(np.sqrt((residuals**2).sum(axis=1).mean())), T_image_board, in_camera_m))
    # The back of the board: a mirror image, as the board is printed on one side.
    fits = [fit for fit in sorted(fits, key=lambda fit: fit[0]) if _facing(fit[1], fit[2]) > 0.0]
    if not fits:
        return Sighting(detection)
    error_px, T_image_board, in_camera_m = fits[0]
    ambiguous = (
        len(fits) > 1
        and fits[1][0] < AMBIGUOUS_RATIO * error_px
        and np.degrees(angle_rad(inverse(T_image_board) @ fits[1][1])) > AMBIGUOUS_DEG
    )
    tilt_deg = float(np.degrees(np.arccos(np.clip(_facing(T_image_board, in_camera_m), 0.0, 1.0))))
    covariance = _covariance(camera, T_image_board, in_camera_m, error_px)
    return Sighting(detection, inverse(T_image_board), covariance, error_px, tilt_deg, bool(ambiguous))


def _facing(T_image_board: Transform, in_camera_m: NDArray[np.float64]) -> float:
    """Return the cosine between the board's normal, into it, and the line of sight to the middle of its points."""
    sight_m = in_camera_m.mean(axis=0)
    return float(T_image_board[:3, 2] @ sight_m / np.linalg.norm(sight_m))


def _covariance(
    camera: Intrinsics, T_image_board: Transform, in_camera_m: NDArray[np.float64], error_px: float
) -> NDArray[np.float64]:
    """Return (6, 6) of the camera's position in the board's frame and its rotation in its own, from the geometry."""
    x, y, z = in_camera_m.T
    zero = np.zeros_like(z)
    by_point = np.stack(
        (
            np.stack((camera.fx / z, zero, -camera.fx * x / z**2), axis=-1),
            np.stack((zero, camera.fy / z, -camera.fy * y / z**2), axis=-1),
        ),
        axis=1,
    )
    cross = np.stack(
        (np.stack((zero, -z, y), axis=-1), np.stack((z, zero, -x), axis=-1), np.stack((-y, x, zero), axis=-1)), axis=1
    )
    by_position = np.einsum("nij,jk->nik", by_point, -T_image_board[:3, :3])
    by_rotation = by_point @ cross
    jacobian = np.concatenate((by_position, by_rotation), axis=2).reshape(-1, 6)
    freedom = max(len(jacobian) - 6, 1)
    variance = error_px**2 * len(in_camera_m) / freedom
    return np.asarray(variance * np.linalg.pinv(jacobian.T @ jacobian))
