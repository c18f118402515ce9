# SPDX-License-Identifier: Apache-2.0
"""The halo of stereo matching around what stands still: beside an edge the camera measures the edge's own depth.

Matching compares windows, and one that holds a strong edge takes that edge's disparity even when its middle lies
beside it; so known things look some centimetres wider than they are. Only depths about the edge's own are explained
by it: what stands well before or behind the edge is seen as ever.
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
"""A step of half a margin is an edge: beyond a smaller one the margin behind it holds the halo, too."""


class Margin(NamedTuple):
    """What an edge's depth may be off by: `base_m + noise_per_m * z**2`."""

    base_m: float
    noise_per_m: float


class Halo(NamedTuple):
    """The pixels that have a halo, in `runs` (R, 4) of neighbours in a row, and the band of raw depths of each.

    A run is its row, its first column, and the first of its bands in `near_raw` and `span_raw` (N,), lower end and
    length, and the one after its last.
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
    """Let the edges of `cad_w` (H, W), 1/z of the nearest surface and 0 for none, reach over what lies behind them.

    An edge reaches `padding_m` at its own depth. It is a pixel beside one that lies farther by `STEP_SHARE` of its
    margin. Out (H, W): 1/z of the nearest and of the farthest edge that reaches over a pixel,
    0 where none does. Returns the number of pixels that one reaches.
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
    """List the pixels that an edge reaches, and the band of raw depths that belongs to it there.

    From the nearest edge less its margin to the farthest edge plus its margin, as lower end and length. Out (N,), N
    being what `spread_edges` returned; a pixel is `y * W + x`.
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
    """One run of `drop_halo`; written for the vectoriser."""
    for x in range(len(near_raw)):
        mask[x] &= np.uint16(depth_raw[x] - near_raw[x]) > span_raw[x]


@kernel
def drop_halo(depth_raw: NDArray[np.uint16], top: int, halo: Halo, mask: NDArray[np.uint8]) -> None:
    """Take the pixels of `depth_raw` (H, W) that lie in their halo's band out of `mask` (H, at least W).

    Row 0 of both is row `top` of the picture.
    """
    runs, near_raw, span_raw = Halo(*halo)
    for i in range(len(runs)):
        y, first, start, end = runs[i]
        last = first + end - start
        drop_run(depth_raw[y - top, first:last], near_raw[start:end], span_raw[start:end], mask[y - top, first:last])
