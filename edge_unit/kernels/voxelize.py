# SPDX-License-Identifier: Apache-2.0
"""Foreground pixels counted on the lattice (the paper's Algorithm 1, with its rounding mended)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_unit.kernels.jit import kernel


@kernel
def count_points(
    depth_raw: NDArray[np.uint16],
    mask_words: NDArray[np.uint64],
    mask: NDArray[np.uint8],
    column_rays: NDArray[np.float32],
    row_rays: NDArray[np.float32],
    origin: NDArray[np.float32],
    shape: NDArray[np.int32],
    counts: NDArray[np.uint32],
    touched: NDArray[np.uint32],
) -> int:
    """Deproject the marked pixels onto the lattice and count them; returns how many voxels were touched.

    In units of voxels, with the camera's pose folded in: a pixel at column u, row v and raw depth d lies
    at `(column_rays[u] + row_rays[v]) * d + origin`; `column_rays` (W, 3), `row_rays` (H, 3), `origin` (3,).
    `mask` (H, stride) is also handed in as `mask_words` (H, stride / 8): eight empty pixels are skipped at once.
    `counts` (nx*ny*nz,) is dense and zero before the call; voxels that became non-zero are listed in `touched`,
    by which `forget` makes it zero again. Points outside the lattice are dropped.
    """
    height, width = depth_raw.shape
    nx, ny, nz = shape[0], shape[1], shape[2]
    limit_x, limit_y, limit_z = np.float32(nx), np.float32(ny), np.float32(nz)
    zero = np.float32(0.0)
    found = 0
    for y in range(height):
        row_x, row_y, row_z = row_rays[y, 0], row_rays[y, 1], row_rays[y, 2]
        for word in range(mask_words.shape[1]):
            if mask_words[y, word] == 0:
                continue
            for x in range(8 * word, min(8 * word + 8, width)):
                if mask[y, x] == 0:
                    continue
                d = np.float32(depth_raw[y, x])
                gx = (column_rays[x, 0] + row_x) * d + origin[0]
                gy = (column_rays[x, 1] + row_y) * d + origin[1]
                gz = (column_rays[x, 2] + row_z) * d + origin[2]
                # Below zero is dropped before truncation, so that truncation is floor.
                if gx < zero or gy < zero or gz < zero or gx >= limit_x or gy >= limit_y or gz >= limit_z:
                    continue
                key = (np.int32(gx) * ny + np.int32(gy)) * nz + np.int32(gz)
                if counts[key] == 0:
                    touched[found] = key
                    found += 1
                counts[key] += np.uint32(1)
    return found


@kernel
def forget(counts: NDArray[np.uint32], touched: NDArray[np.uint32], found: int) -> None:
    """Make the dense counter zero again, in proportion to what was touched."""
    for i in range(found):
        counts[touched[i]] = 0
