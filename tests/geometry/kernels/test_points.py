# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.pipeline.edge_halo import runs_of
from geometry.kernels.bundles import plain
from geometry.kernels.foreground import foreground_mask
from geometry.kernels.halo import Halo, drop_halo
from geometry.kernels.limits import Band
from geometry.kernels.points import ROWS_AT_ONCE, count_foreground
from geometry.kernels.voxelize import Counter, Grid, Mask, count_points

SHAPE = (9, 8, 7)


def images(rng: np.random.Generator, height: int, width: int) -> tuple[NDArray[np.uint16], ...]:
    """Return depth, room and the robot's band, each in half of the pixels."""
    depth, room, near = rng.integers(0, 4000, (3, height, width)).astype(np.uint16)
    span = rng.integers(0, 2000, (height, width)).astype(np.uint16)
    return depth, room, near, span


@pytest.mark.parametrize("height", [1, ROWS_AT_ONCE, 3 * ROWS_AT_ONCE - 1, 3 * ROWS_AT_ONCE + 1])
@pytest.mark.parametrize("width", [8, 61])
def test_a_few_rows_at_a_time_equal_the_whole_image(height: int, width: int) -> None:
    rng = np.random.default_rng(height * width)
    depth, room, near, span = images(rng, height, width)
    columns = np.sort(rng.integers(0, width + 1, (height, 2)), axis=1).astype(np.int32)
    pixels = np.flatnonzero(rng.random((height, width)) < 0.4).astype(np.int32)
    runs = runs_of(pixels, width)
    halo_near, halo_span = rng.integers(0, 3000, (2, len(pixels))).astype(np.uint16)
    rays = rng.normal(0.0, 0.002, (3, width)).astype(np.float32), rng.normal(0.0, 0.002, (height, 3)).astype(np.float32)
    lattice = np.array((4.0, 4.0, 3.0), np.float32), np.array(SHAPE, np.int32)
    size = int(np.prod(np.array(SHAPE) + 2)) + 1
    stride = -(-width // 8) * 8

    mask = np.zeros((height, stride), np.uint8)
    counts, touched = np.zeros(size, np.uint32), np.zeros(size, np.uint32)
    robot, halo = plain(Band(near, span, columns)), plain(Halo(runs, halo_near, halo_span))
    grid, slots = plain(Grid(*rays, *lattice)), np.empty(width, np.int32)
    foreground_mask(depth, room, 1, robot, mask)
    drop_halo(depth, 0, halo, mask)
    marked, counter = plain(Mask(mask.view(np.uint64), mask)), plain(Counter(counts, touched, slots))
    found = count_points(depth, marked, grid, counter, 0)

    rows = np.zeros((ROWS_AT_ONCE, stride), np.uint8)
    again, touched_again = np.zeros(size, np.uint32), np.zeros(size, np.uint32)
    scratch = plain(Mask(rows.view(np.uint64), rows))
    counter_again = plain(Counter(again, touched_again, slots))
    found_again = count_foreground(depth, room, 1, robot, halo, grid, scratch, counter_again)
    assert found_again == found > 0
    assert (again[:-1] == counts[:-1]).all()
    assert (touched_again == touched).all()
