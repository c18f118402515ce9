# SPDX-License-Identifier: Apache-2.0
"""How well measured depth fits expected depth: what tells a covered or a knocked camera from an empty cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel

RESIDUAL_BINS = 201
"""Residuals are binned by a hundredth of the tolerance, from minus to plus one tolerance."""


class Tolerance(NamedTuple):
    """How far a depth may lie from another: `base_raw + per_raw2 * z**2`, in raw units."""

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
    """Compare every `stride_px`-th pixel with the static surface that is expected there.

    `static_raw` (H, W) is the expected raw depth, 0 where nothing is known; pixels that the robot may cover are left
    out. A pixel agrees when it is within its tolerance of it. Out: `tallies` (4,) =
    pixels looked at, of these measured, measured where a static surface is expected, of these agreeing; `residual_bins`
    (RESIDUAL_BINS,) the residuals of those that agree, in hundredths of their tolerance.
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
