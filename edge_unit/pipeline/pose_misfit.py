# SPDX-License-Identifier: Apache-2.0
"""Misfit of a frame to the known surfaces, at the camera's pose and at neighbouring poses.

A knocked camera still agrees with most of its expected depth, within the noise of one pixel. Thousands of pixels
together show which of two poses explains a frame better, along edges as well as on planes. Nothing is drawn for it: the
measured points are looked up in one expected image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.kernels import misfit
from geometry.kernels.agreement import Tolerance
from geometry.kernels.bundles import plain
from geometry.rendering.kernel_camera import camera_of
from shared.camera import Intrinsics
from shared.settings import FilterSettings
from shared.transforms import from_xyz_rpy

STEP_RAD = np.radians(0.7)
STEP_M = 0.015
"""Distance of the neighbouring poses: less than a knock that matters, more than a pixel."""

STEPS = np.array([STEP_RAD] * 3 + [STEP_M] * 3)
"""Steps on the six axes: turns about the camera's x, y and z, and shifts along them."""

COLUMNS_LOOKED_AT = 106
"""Some 6,000 pixels: enough of them lie at edges, and a check costs a third of a frame."""

SCALE_BASE_M = 0.01
SCALE_NOISE_GAIN = 1.5
"""A residual of so many standard deviations of stereo noise, and 10 mm, counts half."""


@dataclass(frozen=True, eq=False)
class Misfit:
    """The fit of one frame at its camera's pose.

    Attributes:
        slope: (6,) misfit a pixel one step ahead on each axis less that one step back; 0 where the pose is right.
        curvature: (6,) the sum of both less twice the misfit of the expected pose: how well an axis is determined.
        valid_share: share of the measured pixels.
        beyond_share: of the pixels compared, the share that is farther away than the known surface.
        static_share: share of the pixels on a known static surface.
    """

    slope: NDArray[np.float64]
    curvature: NDArray[np.float64]
    valid_share: float
    beyond_share: float
    static_share: float


class MisfitCheck:
    """Compares frames of one camera with its static layer."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        self._intrinsics = intrinsics
        self._camera = camera_of(intrinsics)
        self._stride_px = max(round(intrinsics.width / COLUMNS_LOOKED_AT), 1)
        self._T_expected_there = _places(intrinsics.depth_scale_m)
        rows, columns = (len(range(self._stride_px // 2, size, self._stride_px)) for size in intrinsics.shape)
        self._points_raw = np.zeros((3, rows * columns), np.float32)
        self._tallies = np.zeros(4, np.int64)

    def check(
        self,
        depth_raw: NDArray[np.uint16],
        static_raw: NDArray[np.uint16],
        robot_near_raw: NDArray[np.uint16],
        settings: FilterSettings,
    ) -> Misfit:
        """Compare a frame (H, W) with the static surfaces (H, W), 0 where nothing is known, all raw."""
        camera = self._intrinsics
        scale_m = camera.depth_scale_m
        noise_per_raw2 = camera.disparity_noise_m(settings.stereo_subpixel_px) * scale_m
        margin = plain(Tolerance(settings.margin_base_m / scale_m, settings.margin_noise_gain * noise_per_raw2))
        scale = plain(Tolerance(SCALE_BASE_M / scale_m, SCALE_NOISE_GAIN * noise_per_raw2))
        compared = misfit.compared_points(
            depth_raw,
            static_raw,
            robot_near_raw,
            self._camera,
            margin,
            self._stride_px,
            self._points_raw,
            self._tallies,
        )
        sums = [
            misfit.misfit_there(self._points_raw, compared, static_raw, self._camera, T, scale)
            for T in self._T_expected_there
        ]
        here, (ahead, back) = sums[0] / max(compared, 1), np.reshape(sums[1:], (6, 2)).T / max(compared, 1)
        looked, static, measured, beyond = (int(tally) for tally in self._tallies)
        return Misfit(
            slope=ahead - back,
            curvature=ahead + back - 2.0 * here,
            valid_share=measured / max(looked, 1),
            beyond_share=beyond / max(compared, 1),
            static_share=static / max(looked, 1),
        )


def _places(depth_scale_m: float) -> NDArray[np.float64]:
    """Return the expected pose, and one step ahead and back on each axis; translations in raw units."""
    places = [np.eye(4)]
    for axis in range(6):
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            step[axis] = sign * STEPS[axis]
            places.append(from_xyz_rpy(step[3:] / depth_scale_m, step[:3]))
    return np.array(places)
