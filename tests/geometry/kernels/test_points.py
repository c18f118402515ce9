# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.pipeline.edge_halo import runs_of
from geometry.kernels.foreground import foreground_mask
from geometry.kernels.halo import drop_halo
from geometry.kernels.points import ROWS_AT_ONCE, count_foreground
from geometry.kernels.voxelize import count_points

SHAPE = (9, 8, 7)


def images(rng: np.random.Generator, height: int, width: int) -> tuple[NDArray[np.uint16], ...]:
    """Depth, room, and the robot's band, in half of the pixels each."""
    depth, room, near = rng.integers(0, 4000, (3, height, width)).astype(np.uint16)
    span = rng.integers(0, 2000, (height, width)).astype(np.uint16)
    return depth, room, near, span


@pytest.mark.parametrize("height", [1, ROWS_AT_ONCE, 3 * ROWS_AT_ONCE - 1, 3 * ROWS_AT_ONCE + 1])
@pytest.mark.parametrize("width", [8, 61])
def test_a_few_rows_at_a_time_are_the_whole_image_at_once(height: int, width: int) -> None:
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
    foreground_mask(depth, room, near, span, columns, 1, mask)
    drop_halo(depth, 0, runs, halo_near, halo_span, mask)
    slots = np.empty(width, np.int32)
    found = count_points(depth, mask.view(np.uint64), mask, *rays, *lattice, slots, counts, touched, 0)

    rows = np.zeros((ROWS_AT_ONCE, stride), np.uint8)
    again, touched_again = np.zeros(size, np.uint32), np.zeros(size, np.uint32)
    found_again = count_foreground(
        depth, room, near, span, columns, 1, runs, halo_near, halo_span, *rays, *lattice,
        rows.view(np.uint64), rows, slots, again, touched_again,
    )  # fmt: skip
    assert found_again == found > 0
    assert (again[:-1] == counts[:-1]).all()
    assert (touched_again == touched).all()
