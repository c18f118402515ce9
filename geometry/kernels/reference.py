# SPDX-License-Identifier: Apache-2.0
"""Background model of the empty cell, learned pixel by pixel.

Each pixel keeps a few *modes*: depths that occurred repeatedly, with their mean and spread. A flickering edge has two.
A person who walks past causes one that stays rare. The result is the nearest mode that is not rare among all frames in
which the pixel was observed, measured or not. Unmeasured frames count too: where the empty cell gives no measurement, a
passing person is the only thing ever measured, and is still rare.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.limits import RAW_MAX

TAIL_SIGMAS = 4.0
"""Standard deviations at which `students_excess` holds; margins are about four spreads."""

MODES = 4
"""Modes of a pixel: two surfaces at an edge, the flying depths between them, and one for a passing person."""


class Modes(NamedTuple):
    """Learned state of each pixel: the number of `looks` (H, W), and for each mode its count, mean and sum of squares.

    `numbers`, `means_m`, `squares_m2` are (H, W, MODES).
    """

    looks: NDArray[np.uint16]
    numbers: NDArray[np.uint16]
    means_m: NDArray[np.float32]
    squares_m2: NDArray[np.float32]


class Matching(NamedTuple):
    """Matching of depths up to `range_max_m`: those within `base_m + noise_per_m * z**2` are one surface."""

    depth_scale_m: float
    range_max_m: float
    base_m: float
    noise_per_m: float


class Prior(NamedTuple):
    """Rules for the result: a mode is valid if it has at least `share_min` of the looks.

    Its spread is drawn towards `noise_per_m * z**2` with the weight of `weight` frames.
    """

    share_min: float
    weight: float
    noise_per_m: float


@kernel
def observe(
    depth_raw: NDArray[np.uint16],
    robot_near_raw: NDArray[np.uint16],
    robot_span_raw: NDArray[np.uint16],
    matching: Matching,
    modes: Modes,
) -> None:
    """Add one frame to the modes of every pixel (Welford's running mean and sum of squares).

    A pixel inside the robot's band, or unmeasured where the robot is, does not count as a look at the background.
    A depth that is absent or beyond the range is a look without a result. Any other depth joins the mode that it
    matches, or starts one; if all are in use, it replaces the rarest.
    """
    depth_scale_m, range_max_m, match_base_m, match_noise_per_m = Matching(*matching)
    looks, numbers, means_m, squares_m2 = Modes(*modes)
    height, width = depth_raw.shape
    for y in range(height):
        for x in range(width):
            raw = depth_raw[y, x]
            near = robot_near_raw[y, x]
            if near < RAW_MAX and (raw == 0 or np.uint16(raw - near) <= robot_span_raw[y, x]):
                continue
            looks[y, x] += 1
            z = np.float32(raw * depth_scale_m)
            if raw == 0 or z > range_max_m:
                continue
            reach = match_base_m + match_noise_per_m * z * z
            rarest = 0
            joined = -1
            for k in range(MODES):
                number = numbers[y, x, k]
                if number > 0 and abs(z - means_m[y, x, k]) <= reach:
                    joined = k
                    break
                if number < numbers[y, x, rarest]:
                    rarest = k
            if joined < 0:
                numbers[y, x, rarest] = 1
                means_m[y, x, rarest] = z
                squares_m2[y, x, rarest] = 0.0
            elif numbers[y, x, joined] < 65535:
                numbers[y, x, joined] += 1
                before = z - means_m[y, x, joined]
                means_m[y, x, joined] += before / numbers[y, x, joined]
                squares_m2[y, x, joined] += before * (z - means_m[y, x, joined])


@kernel
def students_excess(freedom: float) -> float:
    """Return the factor by which few samples widen a spread of about four deviations: Student's quantile over normal.

    Two terms of Fisher's expansion, at four standard deviations.
    """
    q2 = TAIL_SIGMAS * TAIL_SIGMAS
    first = (q2 + 1.0) / (4.0 * freedom)
    return 1.0 + first + (5.0 * q2 * q2 + 16.0 * q2 + 3.0) / (96.0 * freedom * freedom)


@kernel
def conclude(modes: Modes, prior: Prior, reference_m: NDArray[np.float32], spread_m: NDArray[np.float32]) -> None:
    """Select the nearest mode that is not rare among a pixel's looks, and its standard deviation.

    The spread is drawn towards the camera's model, since the spread of few frames is unreliable, and widened according
    to Student's t. `reference_m`, `spread_m` (H, W) are NaN for pixels without a result.
    """
    looks, numbers, means_m, squares_m2 = Modes(*modes)
    share_min, prior_weight, prior_noise_per_m = Prior(*prior)
    height, width = reference_m.shape
    for y in range(height):
        for x in range(width):
            best = -1
            for k in range(MODES):
                credible = numbers[y, x, k] > 0 and numbers[y, x, k] >= share_min * looks[y, x]
                if credible and (best < 0 or means_m[y, x, k] < means_m[y, x, best]):
                    best = k
            if best < 0:
                reference_m[y, x] = np.nan
                spread_m[y, x] = np.nan
                continue
            z = means_m[y, x, best]
            model = prior_noise_per_m * z * z
            squares = squares_m2[y, x, best] + prior_weight * model * model
            reference_m[y, x] = z
            freedom = prior_weight + numbers[y, x, best] - 1.0
            spread_m[y, x] = math.sqrt(squares / freedom) * students_excess(freedom)
