# SPDX-License-Identifier: Apache-2.0
"""Agreement of measured with expected depth; it distinguishes a covered or moved camera from an empty cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel

RESIDUAL_BINS = 201
"""Number of residual bins, each a hundredth of the tolerance wide, from minus to plus one tolerance."""


class Tolerance(NamedTuple):
    """Tolerance between two depths at depth z: `base_raw + per_raw2 * z**2`, in raw units."""

    base_raw: float
    per_raw2: float


@kernel
def compare(
    depth_raw: NDArray[np.uint16],
    static_raw: NDArray[np.uint16],
    robot_near_raw: NDArray[np.uint16],
    tolerance: Tolerance,
    stride_px: int,
    residual_bins: NDArray[np.int64],
    tallies: NDArray[np.int64],
) -> None:
    """Compare every `stride_px`-th pixel with the expected static surface.

    `static_raw` (H, W) is the expected raw depth, 0 if not known. Pixels that the robot may cover are left out. A pixel
    agrees if it is within the tolerance of the expected depth. Out: `tallies` (4,), the counts of sampled pixels, of
    measured ones, of measured ones with a static surface expected, and of those the agreeing ones; `residual_bins`
    (RESIDUAL_BINS,), the histogram of residuals of agreeing pixels, in hundredths of their tolerance.
    """
    tolerance = Tolerance(*tolerance)
    residual_bins[:] = 0
    tallies[:] = 0
    height, width = depth_raw.shape
    middle = RESIDUAL_BINS // 2
    for y in range(stride_px // 2, height, stride_px):
        for x in range(stride_px // 2, width, stride_px):
            tallies[0] += 1
            raw = depth_raw[y, x]
            if raw == 0:
                continue
            tallies[1] += 1
            expected = np.float64(static_raw[y, x])
            if expected == 0.0 or robot_near_raw[y, x] < 65535:
                continue
            tallies[2] += 1
            tolerated = tolerance.base_raw + tolerance.per_raw2 * expected * expected
            residual = (np.float64(raw) - expected) / tolerated
            if abs(residual) <= 1.0:
                tallies[3] += 1
                residual_bins[middle + int(np.rint(residual * middle))] += 1
