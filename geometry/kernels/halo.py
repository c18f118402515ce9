# SPDX-License-Identifier: Apache-2.0
"""The halo of stereo matching around static edges: beside an edge the camera measures the depth of the edge.

Matching compares windows. A window with a strong edge takes the disparity of that edge even when its centre is beside
it, so known objects look some centimetres wider than they are. The halo explains only depths near that of the edge:
objects well before or behind the edge are seen as usual.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.limits import RAW_MAX, less_noise
from geometry.kernels.pinhole import Camera

STEP_SHARE = 0.5
"""Least depth step of an edge, in margins: for a smaller step, the margin of the surface behind contains the halo."""


class Margin(NamedTuple):
    """Margin of an edge's depth: `base_m + noise_per_m * z**2`."""

    base_m: float
    noise_per_m: float


class Halo(NamedTuple):
    """Pixels with a halo, in `runs` (R, 4) of neighbours in a row, and the band of raw depths of each pixel.

    A run is its row, its first column, the index of its first band in `near_raw` and `span_raw` (N,), which are lower
    end and length, and the index after its last.
    """

    runs: NDArray[np.int32]
    near_raw: NDArray[np.uint16]
    span_raw: NDArray[np.uint16]


@kernel
def spread_edges(
    cad_w: NDArray[np.float32],
    padding_m: float,
    margin: Margin,
    camera: Camera,
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
) -> int:
    """Spread the edges of `cad_w` (H, W), 1/z of the nearest surface and 0 for none, over the pixels behind them.

    An edge is a pixel beside one that is farther by `STEP_SHARE` of its margin. It reaches `padding_m` at its own
    depth. Out (H, W): 1/z of the nearest and of the farthest edge that reaches a pixel, 0 for none. Returns the number
    of pixels reached.
    """
    margin, camera = Margin(*margin), Camera(*camera)
    height, width = cad_w.shape
    nearest_w[:] = 0.0
    farthest_w[:] = 0.0
    number = 0
    for y in range(height):
        for x in range(width):
            w = cad_w[y, x]
            if not w > 0.0:
                continue
            z = 1.0 / w
            behind_w = np.float32(1.0 / (z + STEP_SHARE * (margin.base_m + margin.noise_per_m * z * z)))
            lowest_w = min(
                min(cad_w[y, max(x - 1, 0)], cad_w[y, min(x + 1, width - 1)]),
                min(cad_w[max(y - 1, 0), x], cad_w[min(y + 1, height - 1), x]),
            )
            if not lowest_w < behind_w:
                continue
            reach_rows = padding_m * camera.fy * w
            rows = int(min(reach_rows, float(height)))
            for row in range(max(y - rows, 0), min(y + rows, height - 1) + 1):
                share = (row - y) / reach_rows if reach_rows > 0.0 else 0.0
                columns = int(min(padding_m * camera.fx * w * math.sqrt(max(1.0 - share * share, 0.0)), float(width)))
                for column in range(max(x - columns, 0), min(x + columns, width - 1) + 1):
                    if cad_w[row, column] < behind_w:
                        if nearest_w[row, column] == 0.0:
                            number += 1
                            farthest_w[row, column] = w
                        nearest_w[row, column] = max(nearest_w[row, column], w)
                        farthest_w[row, column] = min(farthest_w[row, column], w)
    return number


@kernel
def halo_bands(
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    margin: Margin,
    depth_scale_m: float,
    pixels: NDArray[np.int32],
    near_raw: NDArray[np.uint16],
    span_raw: NDArray[np.uint16],
) -> None:
    """List the pixels that an edge reaches, with their bands of raw depths.

    A band extends from the nearest edge less its margin to the farthest edge plus its margin, as lower end and length.
    Out (N,), where N is the result of `spread_edges`; a pixel is `y * W + x`.
    """
    base_m, noise_per_m = Margin(*margin)
    height, width = nearest_w.shape
    number = 0
    for y in range(height):
        for x in range(width):
            w = nearest_w[y, x]
            if w == 0.0:
                continue
            z_near, z_far = 1.0 / w, 1.0 / farthest_w[y, x]
            low = math.floor((less_noise(z_near, noise_per_m * z_near * z_near) - base_m) / depth_scale_m)
            high = math.ceil((z_far + (base_m + noise_per_m * z_far * z_far)) / depth_scale_m)
            low, high = min(max(low, 0), RAW_MAX), min(max(high, 0), RAW_MAX)
            pixels[number] = y * width + x
            near_raw[number] = np.uint16(low)
            span_raw[number] = np.uint16(high - low)
            number += 1


@kernel
def drop_run(
    depth_raw: NDArray[np.uint16],
    near_raw: NDArray[np.uint16],
    span_raw: NDArray[np.uint16],
    mask: NDArray[np.uint8],
) -> None:
    """Process one run of `drop_halo`; written for the vectoriser."""
    for x in range(len(near_raw)):
        mask[x] &= np.uint16(depth_raw[x] - near_raw[x]) > span_raw[x]


@kernel
def drop_halo(depth_raw: NDArray[np.uint16], top: int, halo: Halo, mask: NDArray[np.uint8]) -> None:
    """Clear the pixels in `mask` (H, at least W) whose `depth_raw` (H, W) lies in the band of their halo.

    Row 0 of both is row `top` of the image.
    """
    runs, near_raw, span_raw = Halo(*halo)
    for i in range(len(runs)):
        y, first, start, end = runs[i]
        last = first + end - start
        drop_run(depth_raw[y - top, first:last], near_raw[start:end], span_raw[start:end], mask[y - top, first:last])
