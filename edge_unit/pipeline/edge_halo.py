# SPDX-License-Identifier: Apache-2.0
"""False depths that a camera measures beside edges of the CAD; a background model already contains its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.kernels import halo
from geometry.kernels.bundles import plain
from geometry.rendering.kernel_camera import camera_of
from shared.camera import Intrinsics


class EdgeHalo:
    """Pixels beside known edges, each with the band of depths that its edge explains.

    Attributes:
        runs: (R, 4) int32, the pixels as runs of neighbours, see `runs_of`.
        near_raw, span_raw: (N,) uint16, each pixel's band as its lower end and its length.
        bundle: all three, for kernels.
    """

    def __init__(self, intrinsics: Intrinsics) -> None:
        self._intrinsics = intrinsics
        self._pixels = np.empty(0, np.int32)
        self.runs = np.empty((0, 4), np.int32)
        self.near_raw = np.empty(0, np.uint16)
        self.span_raw = np.empty(0, np.uint16)
        self.bundle = plain(halo.Halo(self.runs, self.near_raw, self.span_raw))

    def renew(self, cad_w: NDArray[np.float32], padding_m: float, base_m: float, noise_per_m: float) -> None:
        """Find the edges of `cad_w` (H, W), 1/z of the nearest surface, 0 for none.

        They reach `padding_m`, at depths within `base + noise * z**2` of their own.
        """
        camera = self._intrinsics
        nearest_w, farthest_w = np.empty(camera.shape, np.float32), np.empty(camera.shape, np.float32)
        margin = plain(halo.Margin(base_m, noise_per_m))
        number = halo.spread_edges(cad_w, padding_m, margin, camera_of(camera), nearest_w, farthest_w)
        self._pixels = np.empty(number, np.int32)
        self.near_raw = np.empty(number, np.uint16)
        self.span_raw = np.empty(number, np.uint16)
        halo.halo_bands(
            nearest_w,
            farthest_w,
            margin,
            camera.depth_scale_m,
            self._pixels,
            self.near_raw,
            self.span_raw,
        )
        self.runs = runs_of(self._pixels, camera.width)
        self.bundle = plain(halo.Halo(self.runs, self.near_raw, self.span_raw))

    def drop(self, depth_raw: NDArray[np.uint16], mask: NDArray[np.uint8]) -> None:
        """Remove the pixels that an edge explains from `mask` (H, at least W)."""
        halo.drop_halo(depth_raw, 0, self.bundle, mask)

    def lower(self, limit_raw: NDArray[np.uint16], out: NDArray[np.uint16]) -> None:
        """Copy `limit_raw` (H, W) to `out`; a halo that may hide something lowers it to the near end of its band."""
        np.copyto(out, limit_raw)
        flat = out.reshape(-1)
        flat[self._pixels] = np.minimum(flat[self._pixels], self.near_raw)


def runs_of(pixels: NDArray[np.int32], width: int) -> NDArray[np.int32]:
    """Return pixels (N,) `y * width + x`, ascending, as runs (R, 4): row, first column, start and end in N."""
    is_first = np.ones(len(pixels), np.bool_)
    is_first[1:] = (np.diff(pixels) != 1) | (pixels[1:] % width == 0)
    starts = np.flatnonzero(is_first)
    rows, columns = np.divmod(pixels[starts], width)
    return np.stack((rows, columns, starts, np.append(starts[1:], len(pixels))[: len(starts)]), axis=1).astype(np.int32)
