# SPDX-License-Identifier: Apache-2.0
"""Fit of the measured depth to the expected depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.kernels import agreement
from geometry.kernels.bundles import plain
from shared.camera import Intrinsics
from shared.settings import FilterSettings

STRIDE_PX = 8
"""One pixel in 64 is checked: 14,400 of the largest image, a hundred times more than shares need."""


@dataclass(frozen=True)
class Health:
    """The health of a frame, which each update carries.

    Attributes:
        valid_share: share of the measured pixels.
        agreeing_share: share of the measured pixels on a known static surface that lie within its margin.
        residual_share: median of measured less expected depth of those, in parts of the margin (-1 to 1).
        static_share: share of the pixels on a known static surface; where it is 0 the two above are 0 too.
    """

    valid_share: float
    agreeing_share: float
    residual_share: float
    static_share: float


class HealthCheck:
    """Compares a few pixels of a frame with the static layer."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        self._intrinsics = intrinsics
        self._bins = np.zeros(agreement.RESIDUAL_BINS, np.int64)
        self._tallies = np.zeros(4, np.int64)

    def check(
        self,
        depth_raw: NDArray[np.uint16],
        static_raw: NDArray[np.uint16],
        robot_near_raw: NDArray[np.uint16],
        settings: FilterSettings,
    ) -> Health:
        """Compare a frame (H, W) with the static surfaces (H, W), 0 where nothing is known, all raw."""
        scale_m = self._intrinsics.depth_scale_m
        noise_per_m = self._intrinsics.disparity_noise_m(settings.stereo_subpixel_px)
        agreement.compare(
            depth_raw,
            static_raw,
            robot_near_raw,
            plain(
                agreement.Tolerance(
                    settings.margin_base_m / scale_m, settings.margin_noise_gain * noise_per_m * scale_m
                )
            ),
            STRIDE_PX,
            self._bins,
            self._tallies,
        )
        looked, measured, static, agreeing = (int(tally) for tally in self._tallies)
        return Health(
            valid_share=measured / max(looked, 1),
            agreeing_share=agreeing / max(static, 1),
            residual_share=self._median(agreeing),
            static_share=static / max(looked, 1),
        )

    def _median(self, agreeing: int) -> float:
        """Median of the binned residuals."""
        if agreeing == 0:
            return 0.0
        middle = int(np.searchsorted(np.cumsum(self._bins), (agreeing + 1) // 2))
        half = agreement.RESIDUAL_BINS // 2
        return (middle - half) / half
