# SPDX-License-Identifier: Apache-2.0
"""Refinement of the camera's pose by the CAD that it measures.

Point to plane, as in Chen and Medioni (1992), but over a robust cost that also uses edges: the border of a table fixes
axes that its top leaves free. Newton's method on six axes with finite differences; the measured points are looked up in
one expected image, so a step costs milliseconds. An axis that the view does not determine keeps its old value. A pose
that is worse, or far from the old one, is never accepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.kernels import align
from geometry.kernels.bundles import plain
from geometry.rendering.kernel_camera import camera_of
from shared.camera import Intrinsics
from shared.errors import InputError
from shared.transforms import Transform, from_xyz_rpy

UNITS = np.array([np.radians(0.25)] * 3 + [0.005] * 3)
"""A turn and a shift of equal weight: at a metre both move the image by the same amount."""

REACH, SAMPLES = 4.0, 12
"""Range, in units, and step of the search along a direction that only edges determine."""

SCALES = (8.0, 4.0, 2.0, 1.0, 0.5)
"""Scales of the robust cost, from coarse to fine, in parts of the finest."""

ITERATIONS = 8
"""Newton steps for each scale; it needs three to five."""

EDGE_BEND = 1e-3
"""If inverse depth bends by more than this part of itself over three pixels, an edge is crossed."""

SCALE_BASE_M = 0.006
SCALE_NOISE_GAIN = 0.3
"""The finest scale: 10 mm and so many standard deviations of stereo noise."""

POINTS_MAX = 160_000
"""Diagonals of pixels are thinned so that about so many points remain; more do not improve the result."""

POINTS_MIN = 2_000
"""Points near known surfaces; with fewer a pose is not refined."""

FIRMNESS_MIN = 0.001
"""A direction in which the cost is curved less than this part of the firmest one keeps its old value."""

FAR_RAD = np.radians(5.0)
FAR_M = 0.10
"""Beyond this distance the error was not small: calibrate with the board."""

CONVERGED = 0.02
"""Size of the last step: 0.1 mm, 0.005 degrees."""

GAIN_MIN = 0.01
"""The cost must fall by this part of itself, or the old pose is kept."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """The result of a refinement.

    Attributes:
        T_world_camera: the refined pose; the old one if it was not accepted.
        accepted: True if it is better, and near.
        reason: the gain in words, or the reason against it.
        before_mm, after_mm: median distance of the measured points from the known planes.
        moved_mm, moved_deg: distance of the refined pose from the old one.
    """

    T_world_camera: Transform
    accepted: bool
    reason: str
    before_mm: float
    after_mm: float
    moved_mm: float
    moved_deg: float


class Refiner:
    """Refines one camera's pose.

    `expected_m` (H, W) is the depth of the CAD from the old pose, in metres, inf where nothing is known; without the
    background model, since the camera itself measured that.
    """

    def __init__(
        self, intrinsics: Intrinsics, T_world_camera: Transform, expected_m: NDArray[np.float32], noise_per_m: float
    ) -> None:
        self._intrinsics = intrinsics
        self._T_world_camera = T_world_camera
        expected_m = np.ascontiguousarray(expected_m, np.float32)
        self._expected = plain(align.Planes(expected_m, *planes_of(expected_m, intrinsics)))
        self._camera = camera_of(intrinsics)
        self._noise_per_m = noise_per_m

    @property
    def T_world_camera(self) -> Transform:
        """The old pose."""
        return self._T_world_camera

    def refine(self, frames: Sequence[NDArray[np.uint16]]) -> Refinement:
        """Refine by raw depth images (H, W), 0 where nothing was measured or the robot may stand.

        Raises:
            InputError: there was no frame, or one has the wrong type or shape.
        """
        if not frames:
            raise InputError("refine: expected at least one frame")
        camera = self._intrinsics
        depth_m = median_depth_m([camera.check_depth(each) for each in frames], camera.depth_scale_m)
        points_m = self._points(depth_m)
        scale_m = (SCALE_BASE_M + SCALE_NOISE_GAIN * self._noise_per_m * points_m[2] ** 2).astype(np.float32)
        search = _Search(self, points_m, scale_m)
        before, distances_m = search.cost(np.eye(4), 1.0)
        before_mm = _median_mm(distances_m, scale_m)
        near = int((np.abs(distances_m) < 3.0 * scale_m).sum())
        if near < POINTS_MIN:
            return self._refused(
                f"only {near} of its pixels lie near known surfaces, {POINTS_MIN} are needed: nothing to align with",
                before_mm,
            )
        T = search.run()
        after, distances_m = search.cost(T, 1.0)
        after_mm = _median_mm(distances_m, scale_m)
        moved_m, moved_rad = float(np.linalg.norm(T[:3, 3])), _angle(T)
        moved = f"{1000.0 * moved_m:.1f} mm and {np.degrees(moved_rad):.2f} degrees"
        if moved_m > FAR_M or moved_rad > FAR_RAD:
            why = f"the best fit is {moved} away, too far to be trusted: calibrate with the board"
            return self._refused(why, before_mm, after_mm, moved_m, moved_rad)
        if after > (1.0 - GAIN_MIN) * before:
            return self._refused(
                f"the pose is already the best: planes are {before_mm:.1f} mm off in the median",
                before_mm,
                after_mm,
                moved_m,
                moved_rad,
            )
        reason = f"moved by {moved}: planes are {after_mm:.1f} mm off in the median, {before_mm:.1f} mm before"
        return Refinement(
            self._T_world_camera @ T, True, reason, before_mm, after_mm, 1000.0 * moved_m, float(np.degrees(moved_rad))
        )

    def _refused(
        self, why: str, before_mm: float, after_mm: float = np.nan, moved_m: float = 0.0, moved_rad: float = 0.0
    ) -> Refinement:
        return Refinement(
            self._T_world_camera, False, why, before_mm, after_mm, 1000.0 * moved_m, float(np.degrees(moved_rad))
        )

    def _points(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        camera = self._intrinsics
        v, u = np.nonzero(np.isfinite(depth_m) & (depth_m > 0.0))
        # By position: chosen by count, one pixel more or less would choose all others anew, in columns.
        chosen = (u + v) % (-(-len(v) // POINTS_MAX) or 1) == 0
        v, u = v[chosen], u[chosen]
        z = depth_m[v, u]
        return np.ascontiguousarray(
            np.stack(((u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z)), np.float32
        )


class _Search:
    """Newton's method over one set of points (3, N) with their finest scales (N,)."""

    def __init__(self, refiner: Refiner, points_m: NDArray[np.float32], scale_m: NDArray[np.float32]) -> None:
        self._refiner = refiner
        self._points_m = points_m
        self._scale_m = scale_m
        self._distances_m = np.empty(points_m.shape[1], np.float32)

    def cost(self, T_expected_there: Transform, coarseness: float) -> tuple[float, NDArray[np.float32]]:
        """Return the cost of a pose, and the points' distances from the planes (N,) in metres."""
        r = self._refiner
        measured = plain(align.Measured(self._points_m, np.float32(coarseness) * self._scale_m))
        cost = align.plane_cost(measured, r._expected, r._camera, T_expected_there, self._distances_m)
        return cost, self._distances_m

    def run(self) -> Transform:
        """Return the pose of the least cost near the expected one."""
        T = np.eye(4)
        for coarseness in SCALES:
            for _ in range(ITERATIONS):
                step, _ = self._towards_planes(T, coarseness)
                T = _moved_by(step) @ T
                if np.abs(step / UNITS).max() < CONVERGED:
                    break
            for _ in range(2):
                _, soft = self._towards_planes(T, coarseness)
                for direction in soft:
                    T = self._along(T, direction, coarseness)
                for _ in range(3):
                    step, _ = self._towards_planes(T, coarseness)
                    T = _moved_by(step) @ T
        return T

    def _towards_planes(self, T: Transform, coarseness: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a Gauss-Newton step (6,), and the directions (K, 6) in which the planes leave the pose free."""
        r = self._refiner
        information, gradient = np.empty((6, 6)), np.empty(6)
        measured = plain(align.Measured(self._points_m, np.float32(coarseness) * self._scale_m))
        align.normal_equations(measured, r._expected, r._camera, T, information, gradient)
        values, axes = np.linalg.eigh(information * np.outer(UNITS, UNITS))
        firm = values > FIRMNESS_MIN * values.max()
        step = -(axes[:, firm] / values[firm]) @ (axes[:, firm].T @ (gradient * UNITS))
        return step * UNITS, (axes[:, ~firm] * UNITS[:, None]).T

    def _along(self, T: Transform, direction: NDArray[np.float64], coarseness: float) -> Transform:
        """Return the best pose along a direction that only edges determine."""
        reach = np.linspace(-REACH, REACH, 2 * SAMPLES + 1) * coarseness
        costs = [self.cost(_moved_by(share * direction) @ T, coarseness)[0] for share in reach]
        best = int(np.argmin(costs))
        share = reach[best]
        if 0 < best < len(reach) - 1:
            low, here, high = costs[best - 1], costs[best], costs[best + 1]
            curvature = low - 2.0 * here + high
            if curvature > 0.0:
                share += 0.5 * (low - high) / curvature * (reach[1] - reach[0])
        return _moved_by(share * direction) @ T


def planes_of(
    expected_m: NDArray[np.float32], intrinsics: Intrinsics
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return obliqueness (H, W) and normals (H, W, 3), NaN at edges, of the planes in a depth image (H, W).

    The obliqueness is the distance from the plane for a depth that is 1 m too large; 1 at edges.
    """
    v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    # A plane's inverse depth is linear on the screen: n . ray = 1 / z, with n the normal over its distance.
    with np.errstate(divide="ignore", invalid="ignore"):
        w = np.where(np.isfinite(expected_m), 1.0 / expected_m.astype(np.float64), np.nan)
        w_v, w_u = np.gradient(w)
        bent = np.zeros(w.shape, bool)
        for axis in (0, 1):
            second = np.zeros(w.shape)
            inner = [slice(None)] * 2
            inner[axis] = slice(1, -1)
            second[tuple(inner)] = np.diff(w, 2, axis=axis)
            bent |= ~(np.abs(second) < EDGE_BEND * w)
        normal = np.stack((w_u * intrinsics.fx, w_v * intrinsics.fy, w), -1)
        normal[..., 2] -= normal[..., 0] * x + normal[..., 1] * y
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        normal /= length
        oblique = w / length[..., 0]
    # Along an edge the point belongs to neither of the two surfaces.
    normal[bent | ~np.isfinite(oblique)] = np.nan
    oblique = np.where(np.isfinite(normal[..., 0]), oblique, 1.0)
    return oblique.astype(np.float32), normal.astype(np.float32)


def _moved_by(step: NDArray[np.float64]) -> Transform:
    return from_xyz_rpy(step[3:], step[:3])


def _angle(T: Transform) -> float:
    return float(np.arccos(np.clip(0.5 * (np.trace(T[:3, :3]) - 1.0), -1.0, 1.0)))


def _median_mm(distances_m: NDArray[np.float32], scale_m: NDArray[np.float32]) -> float:
    near = np.abs(distances_m)[np.abs(distances_m) < 3.0 * scale_m]
    return float(1000.0 * np.median(near)) if near.size else float("nan")


def median_depth_m(frames: Sequence[NDArray[np.uint16]], depth_scale_m: float) -> NDArray[np.float32]:
    """Return the median (H, W) in metres over frames; NaN if fewer than half of them measured the pixel."""
    stack = np.stack(frames).astype(np.float32)
    stack[stack == 0.0] = np.nan
    measured = np.isfinite(stack).sum(axis=0)
    stack[:, measured == 0] = 0.0
    median = np.nanmedian(stack, axis=0) * np.float32(depth_scale_m)
    return np.where(2 * measured >= len(stack), median, np.nan).astype(np.float32)
