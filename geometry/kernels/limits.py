# SPDX-License-Identifier: Apache-2.0
"""Limits: expected depth less margins, as raw depth for the comparison with measured pixels.

Limits are uint16 in the camera's own units, so that the filter compares without a conversion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.rasterize import NOTHING_FARTHEST, NOTHING_NEAREST, Buffer, span_of_row

RAW_MAX = 65535
"""The largest raw depth."""

ZERO, ONE, TOP = np.float32(0.0), np.float32(1.0), np.float32(RAW_MAX)
"""Constants in float32: one float64 among them would halve the width of the vector unit."""


class Margins(NamedTuple):
    """Margins between a limit and the expected depth.

    The margin of a CAD surface is `cad_base_m` and `cad_noise_per_m * z**2`; of a learned one `reference_base_m` and
    its spread times `reference_gain`. If neither is known, the limit is `range_max_m`.
    """

    cad_base_m: float
    cad_noise_per_m: float
    reference_base_m: float
    reference_gain: float
    range_max_m: float
    depth_scale_m: float


class Band(NamedTuple):
    """Raw depths of each pixel that belong to the robot: `near_raw` and `span_raw` (H, W), lower end and length.

    In this form the filter needs one unsigned comparison. Without a robot the band is empty: its lower end is beyond
    every limit. `columns` (H, 2) has for each row the first column with a band and the one after the last.
    """

    near_raw: NDArray[np.uint16]
    span_raw: NDArray[np.uint16]
    columns: NDArray[np.int32]


@kernel
def less_noise(z_m: float, noise_m: float) -> float:
    """Return depth `z_m` less its noise, subtracted in disparity, that is in 1/z, where it is symmetric.

    For small noise this is `z - noise`. Far away that difference would fall below 0, since noise grows with the square
    of depth, and a wall at the end of the hall would hide a person before the camera.
    """
    return z_m * z_m / (z_m + noise_m)


@kernel
def static_limit_raw(
    cad_w: NDArray[np.float32],
    reference_m: NDArray[np.float32],
    spread_m: NDArray[np.float32],
    margins: Margins,
    limit_raw: NDArray[np.uint16],
) -> None:
    """Compute for each pixel the raw depth below which a measurement is nearer than all static surfaces.

    It is the nearer of the CAD surface, `cad_w` = 1/z (H, W), and the learned surface, `reference_m` and `spread_m`
    (H, W), NaN if not learned, each less its margin. Out: `limit_raw` (H, W), rounded down.
    """
    cad_base_m, cad_noise_per_m, reference_base_m, reference_gain, range_max_m, depth_scale_m = Margins(*margins)
    height, width = limit_raw.shape
    for y in range(height):
        for x in range(width):
            limit_m = range_max_m
            w = cad_w[y, x]
            if w > 0.0:
                z = 1.0 / w
                limit_m = min(limit_m, less_noise(z, cad_noise_per_m * z * z) - cad_base_m)
            learned = reference_m[y, x]
            if learned == learned:
                limit_m = min(limit_m, less_noise(learned, reference_gain * spread_m[y, x]) - reference_base_m)
            limit_raw[y, x] = np.uint16(min(max(math.floor(limit_m / depth_scale_m), 0), RAW_MAX))


@kernel
def nearest_over(
    image: NDArray[np.uint16], radius_px: int, scratch: NDArray[np.uint16], out: NDArray[np.uint16]
) -> None:
    """Compute the minimum over the square of `radius_px` around each pixel (H, W); `scratch` is (H, W)."""
    height, width = image.shape
    for y in range(height):
        for x in range(width):
            nearest = image[y, x]
            for k in range(max(x - radius_px, 0), min(x + radius_px, width - 1) + 1):
                nearest = min(nearest, image[y, k])
            scratch[y, x] = nearest
    for y in range(height):
        for x in range(width):
            out[y, x] = scratch[y, x]
        for k in range(max(y - radius_px, 0), min(y + radius_px, height - 1) + 1):
            for x in range(width):
                out[y, x] = min(out[y, x], scratch[k, x])


@kernel
def empty_row(near_raw: NDArray[np.uint16], span_raw: NDArray[np.uint16], first: int, end: int) -> None:
    """Empty the band from column `first` to before `end`."""
    if first < end:
        near_raw[first:end] = np.uint16(RAW_MAX)
        span_raw[first:end] = np.uint16(0)


@kernel
def band_of_row(
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    noise_per_m: np.float32,
    depth_m: np.float32,
    units_per_m: np.float32,
    near_raw: NDArray[np.uint16],
    span_raw: NDArray[np.uint16],
) -> None:
    """Process a part of a row of `robot_band_raw`; for the vectoriser: no branch, one type, only arrays."""
    for i in range(len(nearest_w)):
        nearest, farthest = nearest_w[i], farthest_w[i]
        # A back without a front: the front is before the near plane, and the camera is inside the padding.
        within = (nearest == NOTHING_NEAREST) & (farthest > NOTHING_FARTHEST)
        z_near = ZERO if within else ONE / nearest
        z_far = max(-ONE / farthest, z_near + depth_m)
        near = min(max((z_near - noise_per_m * z_near * z_near) * units_per_m, ZERO), TOP)
        far = min(max((z_far + noise_per_m * z_far * z_far) * units_per_m, ZERO), TOP)
        low = np.int32(near)
        # The values are meaningless for pixels where nothing was drawn.
        drawn = (nearest > NOTHING_NEAREST) | within
        near_raw[i] = np.uint16(low) if drawn else np.uint16(RAW_MAX)
        span_raw[i] = np.uint16(np.int32(far) - low) if drawn else np.uint16(0)


@kernel
def robot_band_raw(
    buffer: Buffer,
    rectangles: NDArray[np.int32],
    links: NDArray[np.bool_],
    noise_per_m: float,
    depth_m: float,
    depth_scale_m: float,
    band: Band,
) -> None:
    """Compute the band of raw depths in which a measurement belongs to the robot drawn by `rasterize.draw_meshes`.

    The band starts at the nearest padded surface less its noise margin, or at 0 if the camera is inside the padding. It
    ends at the farthest surface, or `depth_m` behind the nearest if that is farther, plus the margin there. So objects
    behind the robot are still seen. `band` is overwritten; its previous content is emptied.
    """
    buffer, band = Buffer(*buffer), Band(*band)
    window, nearest_w, farthest_w = buffer
    near_raw, span_raw, columns = band
    noise = np.float32(noise_per_m)
    depth = np.float32(depth_m)
    units = np.float32(1.0 / depth_scale_m)
    for y in range(len(near_raw)):
        first, end = 0, 0
        if window[0] <= y < window[0] + window[2]:
            first, end = span_of_row(y, rectangles, links, links)
        if columns[y, 0] < columns[y, 1]:
            empty_row(near_raw[y], span_raw[y], columns[y, 0], min(columns[y, 1], first))
            empty_row(near_raw[y], span_raw[y], max(columns[y, 0], end), columns[y, 1])
        columns[y, 0], columns[y, 1] = first, end
        if first < end:
            at = (y - window[0]) * window[3] - window[1]
            band_of_row(
                nearest_w[at + first : at + end],
                farthest_w[at + first : at + end],
                noise,
                depth,
                units,
                near_raw[y, first:end],
                span_raw[y, first:end],
            )


@kernel
def clear_band(band: Band) -> None:
    """Empty the band of the robot everywhere."""
    near_raw, span_raw, columns = Band(*band)
    for y in range(len(near_raw)):
        empty_row(near_raw[y], span_raw[y], columns[y, 0], columns[y, 1])
        columns[y, 0], columns[y, 1] = 0, 0


@kernel
def lower_row(nearest_w: NDArray[np.float32], depth_m: NDArray[np.float32]) -> None:
    """Process a part of a row of `lower_depth`; written for the vectoriser."""
    for i in range(len(nearest_w)):
        # If nothing was drawn, w is 0 and its inverse infinite.
        depth_m[i] = min(depth_m[i], ONE / nearest_w[i])


@kernel
def lower_depth(
    buffer: Buffer, rectangles: NDArray[np.int32], links: NDArray[np.bool_], depth_m: NDArray[np.float32]
) -> None:
    """Lower `depth_m` (H, W) to the surfaces drawn by `rasterize.draw_meshes`, where they are nearer."""
    buffer = Buffer(*buffer)
    window = buffer.window
    for y in range(window[0], window[0] + window[2]):
        first, end = span_of_row(y, rectangles, links, links)
        at = (y - window[0]) * window[3] - window[1]
        lower_row(buffer.nearest_w[at + first : at + end], depth_m[y, first:end])
