# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geometry.kernels.bundles import plain
from geometry.kernels.voxelize import Counter as Slots
from geometry.kernels.voxelize import Grid, Mask, count_points, forget

DOUBT_VOXELS = 1e-3
"""The kernel works in float32: this close to a border it may decide either way."""


class Counter:
    """The kernel with its memory: the lattice, a rim around it, a slot for points outside, and a guard after it."""

    def __init__(self, shape: tuple[int, int, int], pixels: int) -> None:
        self.shape = shape
        rimmed = tuple(number + 2 for number in shape)
        end = int(np.prod(rimmed))
        self.memory = np.zeros(end + 1 + 1000, np.uint32)
        self.counts = self.memory[: end + 1]
        self.guard = self.memory[end + 1 :]
        self.grid = self.counts[:end].reshape(rimmed)
        self.voxels = self.grid[1:-1, 1:-1, 1:-1]
        self.touched = np.full(min(pixels, self.voxels.size) + 1, 0xFFFFFFFF, np.uint32)
        self.found = 0

    def run(
        self,
        depth: NDArray[np.uint16],
        mask: NDArray[np.bool_],
        column_rays: NDArray[np.float32],
        row_rays: NDArray[np.float32],
        origin: NDArray[np.float32],
    ) -> NDArray[np.uint32]:
        """Run the kernel; `column_rays` is (W, 3) here, as `row_rays` is (H, 3)."""
        height, width = depth.shape
        padded = np.zeros((height, -(-width // 8) * 8), np.uint8)
        padded[:, :width] = mask
        self.found = count_points(
            depth,
            plain(Mask(padded.view(np.uint64), padded)),
            plain(Grid(np.ascontiguousarray(column_rays.T), row_rays, origin, np.array(self.shape, np.int32))),
            plain(Slots(self.counts, self.touched, np.empty(width, np.int32))),
            0,
        )
        assert not self.guard.any()
        touched = self.touched[: self.found]
        assert len(set(touched.tolist())) == self.found
        assert sorted(touched.tolist()) == np.flatnonzero(self.grid).tolist()
        assert self.voxels.sum() == self.grid.sum(), "the rim stays empty"
        return self.voxels.copy()

    def forget(self) -> None:
        forget(self.counts, self.touched, self.found)
        assert not self.grid.any()


def positions(
    depth: NDArray[np.uint16],
    column_rays: NDArray[np.float32],
    row_rays: NDArray[np.float32],
    origin: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Return the position of each pixel (H, W, 3), in units of voxels."""
    rays = column_rays.astype(np.float64)[None, :, :] + row_rays.astype(np.float64)[:, None, :]
    return np.asarray(rays * depth[:, :, None] + origin)


def twin(points: NDArray[np.float64], mask: NDArray[np.bool_], shape: tuple[int, int, int]) -> NDArray[np.uint32]:
    counts = np.zeros(shape, np.uint32)
    for index in np.floor(points[mask]).astype(np.int64):
        if (index >= 0).all() and (index < shape).all():
            counts[tuple(index)] += 1
    return counts


def rays(
    rng: np.random.Generator, height: int, width: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the rays of a camera in any direction that sees the lattice's corner: half of the points are negative."""
    column = rng.normal(0.0, 0.01, (width, 3)).astype(np.float32)
    row = rng.normal(0.0, 0.01, (height, 3)).astype(np.float32)
    return column, row, rng.normal(4.0, 4.0, 3).astype(np.float32)


@pytest.mark.parametrize("width", [1, 7, 8, 61, 96])
@pytest.mark.parametrize("shape", [(20, 15, 12), (1, 1, 1), (3, 40, 1)])
def test_counts_equal_the_twin(width: int, shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(width)
    height = 41
    counter = Counter(shape, height * width)
    for _ in range(5):
        depth = rng.integers(0, 900, (height, width)).astype(np.uint16)
        column, row, origin = rays(rng, height, width)
        points = positions(depth, column, row, origin)
        mask = rng.random(depth.shape) < 0.5
        mask &= (np.abs(points - np.rint(points)) > DOUBT_VOXELS).all(axis=-1)
        assert (counter.run(depth, mask, column, row, origin) == twin(points, mask, shape)).all()
        counter.forget()


def test_no_pixel_is_marked() -> None:
    counter = Counter((4, 4, 4), 9 * 13)
    depth = np.full((9, 13), 65535, np.uint16)
    nothing = np.zeros(depth.shape, np.bool_)
    one = np.ones((13, 3), np.float32)
    assert not counter.run(depth, nothing, one, one[:9], np.zeros(3, np.float32)).any()
    assert counter.found == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_border_belongs_to_the_voxel_above_and_the_last_border_to_none(axis: int) -> None:
    """All numbers are exact in float32: pixels 1/4 voxel apart along an axis, from -1 to 5, on a lattice of 4."""
    depth = np.full((1, 25), 4, np.uint16)
    column = np.zeros((25, 3), np.float32)
    column[:, axis] = np.arange(25) / 16.0
    origin = np.zeros(3, np.float32)
    origin[axis] = -1.0
    shape = [1, 1, 1]
    shape[axis] = 4
    counter = Counter((shape[0], shape[1], shape[2]), 25)
    counts = counter.run(depth, np.ones(depth.shape, np.bool_), column, np.zeros((1, 3), np.float32), origin)
    assert counts.ravel().tolist() == [4, 4, 4, 4]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_just_below_zero_is_outside_on_every_axis(axis: int) -> None:
    """Truncation would take -0.25 into voxel 0."""
    depth, ray = np.ones((1, 1), np.uint16), np.full((1, 3), 0.25, np.float32)
    ray[0, axis] = -0.25
    counter = Counter((2, 2, 2), 1)
    every = np.ones((1, 1), np.bool_)
    zero = np.zeros((1, 3), np.float32)
    assert counter.run(depth, every, ray, zero, np.zeros(3, np.float32)).sum() == 0
    assert counter.run(depth, every, np.abs(ray), zero, np.zeros(3, np.float32))[0, 0, 0] == 1


def test_the_largest_raw_depth_and_points_far_outside() -> None:
    depth = np.full((3, 9), 65535, np.uint16)
    counter = Counter((8, 8, 8), depth.size)
    every, zero = np.ones(depth.shape, np.bool_), np.zeros((3, 3), np.float32)
    for far in (1e-4, 1.0, 1e6, 1e30, -1e30):
        column = np.full((9, 3), far, np.float32)
        counts = counter.run(depth, every, column, zero, np.zeros(3, np.float32))
        assert counts.sum() == (depth.size if far == 1e-4 else 0)
        counter.forget()


def test_as_many_voxels_as_pixels_fit() -> None:
    depth = np.ones((1, 16), np.uint16)
    column = np.zeros((16, 3), np.float32)
    column[:, 2] = np.arange(16) + 0.5
    counter = Counter((1, 1, 16), depth.size)
    counts = counter.run(depth, np.ones(depth.shape, np.bool_), column, np.zeros((1, 3), np.float32), column[0] * 0)
    assert (counts == 1).all()
    assert counter.found == 16
