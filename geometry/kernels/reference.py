# SPDX-License-Identifier: Apache-2.0
"""Surfaces that the empty cell shows, learned pixel by pixel.

Each pixel keeps a few *modes*: depths that came again and again, with their mean and spread. A flickering edge has
two; a person who walks past makes one that stays rare. What counts in the end is the nearest mode that is not rare
among all the looks that the pixel had, measured or not: where the empty cell shows nothing, who walks past is the
only one that is ever measured, and still rare.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.limits import RAW_MAX

TAIL_SIGMAS = 4.0
"""Margins are some four spreads."""

MODES = 4
"""A pixel at an edge shows two surfaces and the flying depths between; one more for who walks past."""


class Modes(NamedTuple):
    """What is known of each pixel: its `looks` (H, W), and of its modes how often each came, mean and sum of squares.

    `numbers`, `means_m`, `squares_m2` are (H, W, MODES).
    """

    looks: NDArray[np.uint16]
    numbers: NDArray[np.uint16]
    means_m: NDArray[np.float32]
    squares_m2: NDArray[np.float32]


class Matching(NamedTuple):
    """Depths up to `range_max_m` count; those within `base_m + noise_per_m * z**2` of one another are one surface."""

    depth_scale_m: float
    range_max_m: float
    base_m: float
    noise_per_m: float


class Prior(NamedTuple):
    """A mode counts that holds `share_min` of the looks.

    Its spread is drawn towards `noise_per_m * z**2` as if `weight` frames had shown that.
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

    What lies inside the robot's band, or is unmeasured where the robot stands, is no look at what is behind it.
    Depths that are absent or beyond the range are a look that showed nothing. Any other depth joins the mode that it
    matches, or starts one, in the place of the rarest when all are taken.
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
    """By how much few samples widen a spread that is multiplied by some four: Student's quantile over the normal one.

    Two terms of Fisher's expansion, at four standard deviations.
    """
    q2 = TAIL_SIGMAS * TAIL_SIGMAS
    first = (q2 + 1.0) / (4.0 * freedom)
    return 1.0 + first + (5.0 * q2 * q2 + 16.0 * q2 + 3.0) / (96.0 * freedom * freedom)


@kernel
def conclude(modes: Modes, prior: Prior, reference_m: NDArray[np.float32], spread_m: NDArray[np.float32]) -> None:
    """The nearest mode that is not rare among a pixel's looks, and its standard deviation.

    The spread is drawn towards the camera's model, for that of few frames is no measure, and widened as Student's t has
    it. `reference_m`, `spread_m` (H, W) are NaN
    where nothing was learned.
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
