# SPDX-License-Identifier: Apache-2.0
"""Surfaces that the empty cell shows, learned pixel by pixel.

Each pixel keeps a few *modes*: depths that came again and again, with their mean and spread. A flickering edge has
two; a person who walks past makes one that stays rare. What counts in the end is the nearest mode that is not rare.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edge_unit.kernels.jit import kernel

MODES = 4
"""A pixel at an edge shows two surfaces and the flying depths between; one more for who walks past."""


@kernel
def observe(
    depth_raw: NDArray[np.uint16],
    robot_near_raw: NDArray[np.uint16],
    robot_span_raw: NDArray[np.uint16],
    depth_scale_m: float,
    range_max_m: float,
    match_base_m: float,
    match_noise_per_m: float,
    numbers: NDArray[np.uint16],
    means_m: NDArray[np.float32],
    squares_m2: NDArray[np.float32],
) -> None:
    """Add one frame to the modes of every pixel (Welford's running mean and sum of squares).

    Depths that are absent, beyond the range, or inside the robot's band are no news. A depth joins the mode within
    `base + noise * z**2` of it; otherwise it starts one, in the place of the rarest when all are taken.
    `numbers`, `means_m`, `squares_m2` are (H, W, MODES).
    """
    height, width = depth_raw.shape
    for y in range(height):
        for x in range(width):
            raw = depth_raw[y, x]
            if raw == 0 or np.uint16(raw - robot_near_raw[y, x]) <= robot_span_raw[y, x]:
                continue
            z = np.float32(raw * depth_scale_m)
            if z > range_max_m:
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
def conclude(
    numbers: NDArray[np.uint16],
    means_m: NDArray[np.float32],
    squares_m2: NDArray[np.float32],
    share_min: float,
    prior_weight: float,
    prior_noise_per_m: float,
    reference_m: NDArray[np.float32],
    spread_m: NDArray[np.float32],
) -> None:
    """The nearest mode that holds at least `share_min` of what a pixel showed, and its standard deviation.

    The spread is drawn towards the camera's model `noise * z**2` as if `prior_weight` frames had shown it, for the
    spread of few frames is no measure. `reference_m`, `spread_m` (H, W) are NaN where nothing was learned.
    """
    height, width = reference_m.shape
    for y in range(height):
        for x in range(width):
            total = 0
            for k in range(MODES):
                total += numbers[y, x, k]
            best = -1
            for k in range(MODES):
                credible = numbers[y, x, k] > 0 and numbers[y, x, k] >= share_min * total
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
            spread_m[y, x] = math.sqrt(squares / (prior_weight + numbers[y, x, best] - 1.0))
