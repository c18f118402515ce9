# SPDX-License-Identifier: Apache-2.0
"""Foreground pixels counted on the lattice (the paper's Algorithm 1, with correct rounding).

The counter is dense and has a rim of one empty voxel all around, so that access to a voxel's neighbours needs no test
for the end of the lattice. A *slot* is an index into it: that of voxel (ix, iy, iz) of a lattice (nx, ny, nz) is
`((ix + 1) * (ny + 2) + iy + 1) * (nz + 2) + iz + 1`. One more slot after the last takes points outside.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel

PIXELS_PER_WORD = 8
"""Pixels in a word: a row of the mask is read in words of 64 bits, so that eight empty pixels are skipped at once."""


class Grid(NamedTuple):
    """The lattice in the frame of one camera, in units of voxels, with the camera's pose included.

    A pixel at column u, row v and raw depth d is at `(column_rays[:, u] + row_rays[v]) * d + origin`;
    `column_rays` (3, W), `row_rays` (H, 3), `origin` (3,). `shape` (3,) is the lattice's.
    """

    column_rays: NDArray[np.float32]
    row_rays: NDArray[np.float32]
    origin: NDArray[np.float32]
    shape: NDArray[np.int32]


class Mask(NamedTuple):
    """The marked pixels: rows of `pixels` (., stride), and the same memory as `words` (., stride / 8)."""

    words: NDArray[np.uint64]
    pixels: NDArray[np.uint8]


class Counter(NamedTuple):
    """`counts` of `(nx + 2) * (ny + 2) * (nz + 2) + 1` slots, zero before the first call.

    Slots that become non-zero are listed in `touched`, which is one longer than the largest number of them; `forget`
    resets them by this list. `slots` (W,) is scratch.
    """

    counts: NDArray[np.uint32]
    touched: NDArray[np.uint32]
    slots: NDArray[np.int32]


class Rays(NamedTuple):
    """The columns' part of the rays of a part of a row."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]


class Ray(NamedTuple):
    """The row's part of its rays."""

    x: np.float32
    y: np.float32
    z: np.float32


class Steps(NamedTuple):
    """The grid and the counter as scalars, which stay in registers."""

    origin_x: np.float32
    origin_y: np.float32
    origin_z: np.float32
    limit_x: np.float32
    limit_y: np.float32
    limit_z: np.float32
    slots_per_y: np.int32
    slots_per_x: np.int32
    first_slot: np.int32
    outside: np.int32


@kernel
def steps_of(grid: Grid, counter: Counter) -> Steps:
    """Return the grid and the counter as scalars."""
    origin, shape = grid.origin, grid.shape
    slots_per_y = np.int32(shape[2] + 2)
    slots_per_x = np.int32(slots_per_y * (shape[1] + 2))
    return Steps(
        origin[0], origin[1], origin[2], np.float32(shape[0]), np.float32(shape[1]), np.float32(shape[2]),
        slots_per_y, slots_per_x, np.int32(slots_per_x + slots_per_y + 1), np.int32(len(counter.counts) - 1),
    )  # fmt: skip


@kernel
def slots_of_row(
    depth_raw: NDArray[np.uint16],
    mask: NDArray[np.uint8],
    rays: Rays,
    row: Ray,
    steps: Steps,
    slots: NDArray[np.int32],
) -> None:
    """Compute the slot of each pixel in a part of a row; for the vectoriser: no branch, 32 bits, only arrays.

    The slot is `outside` for a pixel that is not marked and for a point outside the lattice.
    """
    ray_x, ray_y, ray_z = rays
    row_x, row_y, row_z = row
    origin_x, origin_y, origin_z, limit_x, limit_y, limit_z, slots_per_y, slots_per_x, first_slot, outside = steps
    zero = np.float32(0.0)
    for i in range(len(depth_raw)):
        d = np.float32(depth_raw[i])
        gx = (ray_x[i] + row_x) * d + origin_x
        gy = (ray_y[i] + row_y) * d + origin_y
        gz = (ray_z[i] + row_z) * d + origin_z
        # Values below zero are excluded before truncation, so that truncation is floor.
        inside = (gx >= zero) & (gy >= zero) & (gz >= zero) & (gx < limit_x) & (gy < limit_y) & (gz < limit_z)
        slot = np.int32(np.int32(gx) * slots_per_x) + np.int32(np.int32(gy) * slots_per_y) + np.int32(gz)
        slots[i] = np.int32(slot + first_slot) if inside & (mask[i] != 0) else outside


@kernel
def tally(slots: NDArray[np.int32], counts: NDArray[np.uint32], touched: NDArray[np.uint32], found: int) -> int:
    """Count the `slots`; append those that were empty to the `found` entries of `touched`; return the new number."""
    # Unsigned, since numba tests a signed index for counting from the end.
    end = np.uint64(found)
    for i in range(len(slots)):
        slot = np.uint32(slots[i])
        count = counts[slot]
        # Always written, and counted only if it was the first: a branch would be mispredicted too often.
        touched[end] = slot
        end += np.uint64(count == 0)
        counts[slot] = count + np.uint32(1)
    return np.int64(end)  # type: ignore[return-value]  # to numba it is a plain number


@kernel
def next_marked(words: NDArray[np.uint64], start: int) -> int:
    """Return the first word from `start` on that is not zero, or the number of words."""
    # Unsigned, since numba tests a signed index for counting from the end.
    word, end = np.uint64(start), np.uint64(len(words))
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    while word + four <= end and words[word] | words[word + one] | words[word + two] | words[word + three] == 0:
        word += four
    while word < end and words[word] == 0:
        word += one
    return np.int64(word)  # type: ignore[return-value]  # to numba it is a plain number


@kernel
def next_empty(words: NDArray[np.uint64], start: int) -> int:
    """Return the first word from `start` on that is zero, or the number of words."""
    word, end = np.uint64(start), np.uint64(len(words))
    while word < end and words[word] != 0:
        word += np.uint64(1)
    return np.int64(word)  # type: ignore[return-value]  # to numba it is a plain number


@kernel
def count_points(depth_raw: NDArray[np.uint16], mask: Mask, grid: Grid, counter: Counter, found: int) -> int:
    """Deproject the marked pixels onto the lattice and count them; return the number of voxels touched so far.

    New voxels are appended to the `found` entries of `counter.touched`.
    """
    mask, grid, counter = Mask(*mask), Grid(*grid), Counter(*counter)
    height, width = depth_raw.shape
    words = mask.words.shape[1]
    steps = steps_of(grid, counter)
    rays_x, rays_y, rays_z = grid.column_rays[0], grid.column_rays[1], grid.column_rays[2]
    counts, touched, slots = counter
    # Never zero, so that it is never listed.
    counts[steps.outside] = 1
    for y in range(height):
        row = mask.words[y]
        ray = Ray(grid.row_rays[y, 0], grid.row_rays[y, 1], grid.row_rays[y, 2])
        word = next_marked(row, 0)
        while word < words:
            first = PIXELS_PER_WORD * word
            word = next_empty(row, word)
            end = min(PIXELS_PER_WORD * word, width)
            rays = Rays(rays_x[first:end], rays_y[first:end], rays_z[first:end])
            slots_of_row(depth_raw[y, first:end], mask.pixels[y, first:end], rays, ray, steps, slots[first:end])
            found = tally(slots[first:end], counts, touched, found)
            word = next_marked(row, word)
    return found


@kernel
def forget(counts: NDArray[np.uint32], touched: NDArray[np.uint32], found: int) -> None:
    """Reset the dense counter to zero, at a cost proportional to the number of voxels touched."""
    for i in range(found):
        counts[touched[i]] = 0
