# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.pipeline import SeenBlocks, Voxels
from edge_unit.pipeline.visibility import Visibility
from shared.lattice import MAX_BLOCKS, Lattice
from shared.transforms import apply, inverse, look_at
from tests.edge_unit.scenes import camera

CAMERA = camera(160, 90)
BOX_M = np.array((-1.0, -1.0, -0.2)), np.array((1.0, 1.0, 1.8))
ABOVE = look_at((0.0, 0.05, 1.7), (0.0, 0.0, 0.0))
FAR = np.full(CAMERA.shape, 65535, np.uint16)


def look(depth: NDArray[np.uint16], limit: NDArray[np.uint16] = FAR, robot: NDArray[np.uint16] = FAR) -> SeenBlocks:
    return Visibility(CAMERA, ABOVE, *BOX_M, 0.1, 0.9, 0.0).find_seen(depth, limit, robot)


def depth_of(blocks: SeenBlocks) -> NDArray[np.float64]:
    """Distances of the seen blocks' middles along the camera's axis."""
    keys = np.nonzero(blocks.seen)[0]
    return apply(inverse(ABOVE), blocks.lattice.centres(blocks.lattice.indices(keys)))[:, 2]


def test_blocks_before_a_wall_are_seen_and_those_behind_are_not() -> None:
    wall = look(np.full(CAMERA.shape, 1200, np.uint16))
    assert wall.lattice.shape == (20, 20, 20)
    assert wall.seen.sum() > 100
    assert depth_of(wall).max() < 1.2 - 0.04
    everything = look(FAR)
    beyond = depth_of(everything) < 1.2 - 0.09
    assert wall.seen.sum() >= beyond.sum()


@pytest.mark.parametrize("voxel_size_m", [0.03, 0.05, 0.1, 0.25])
@pytest.mark.parametrize("block_size_m", [0.05, 0.1, 0.14])
def test_blocks_that_hold_part_of_a_voxel_can_be_taken_out(voxel_size_m: float, block_size_m: float) -> None:
    blocks = Lattice.covering(*BOX_M, block_size_m)
    voxel = Lattice.covering(*BOX_M, voxel_size_m)
    keys = np.array([0, 7, voxel.cell_count // 2, voxel.cell_count - 1], np.uint32)
    voxels = Voxels(keys, np.ones(4, np.uint32), voxel)
    everything = SeenBlocks(np.ones(blocks.cell_count, np.uint8), blocks)
    left = everything.without(voxels)
    # A block and a voxel overlap if they overlap on each axis by more than rounding.
    low_m = np.array(voxel.origin_m) + voxels.indices * voxel_size_m + 1e-6
    high_m = low_m + voxel_size_m - 2e-6
    block_low_m = np.array(blocks.origin_m) + np.argwhere(np.ones(blocks.shape)) * blocks.voxel_size_m
    overlap = (block_low_m[:, None] < high_m) & (block_low_m[:, None] + blocks.voxel_size_m > low_m)
    assert (left.seen == ~overlap.all(axis=2).any(axis=1)).all()
    assert everything.seen.all()


def test_seen_blocks_lie_wholly_in_the_image() -> None:
    blocks = look(FAR)
    keys = np.nonzero(blocks.seen)[0]
    index = blocks.lattice.indices(keys)
    for corner in np.ndindex(2, 2, 2):
        world = np.array(blocks.lattice.origin_m) + (index + np.array(corner)) * blocks.lattice.voxel_size_m
        uv = CAMERA.project(apply(inverse(ABOVE), world))
        assert (uv >= 0).all()
        assert (uv <= (CAMERA.width - 1, CAMERA.height - 1)).all()


@pytest.mark.parametrize("image", ["depth", "limit", "robot"])
def test_hidden_blocks_are_not_seen(image: str) -> None:
    images = {"depth": FAR, "limit": FAR, "robot": FAR}
    images[image] = np.zeros(CAMERA.shape, np.uint16)
    assert not look(**images).seen.any()
    half = FAR.copy()
    half[:, :80] = 0
    images[image] = half
    assert 0 < look(**images).seen.sum() < look(FAR).seen.sum()


def test_a_report_is_not_overwritten_by_the_next() -> None:
    visibility = Visibility(CAMERA, ABOVE, *BOX_M, 0.1, 0.9, 0.0)
    first = visibility.find_seen(FAR, FAR, FAR)
    number = first.seen.sum()
    visibility.find_seen(np.zeros_like(FAR), FAR, FAR)
    assert first.seen.sum() == number > 0


def test_a_moved_camera_sees_other_blocks() -> None:
    visibility = Visibility(CAMERA, ABOVE, *BOX_M, 0.1, 0.9, 0.0)
    visibility.place(look_at((0, 0, 1.7), (0, 0, 5.0)))
    assert not visibility.find_seen(FAR, FAR, FAR).seen.any()
    visibility.place(ABOVE)
    assert (visibility.find_seen(FAR, FAR, FAR).seen == look(FAR).seen).all()


def test_packed_bits_start_with_the_first_block_in_the_lowest_bit() -> None:
    lattice = Lattice((0, 0, 0), 0.1, (3, 2, 2))
    seen = np.array([1, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0], np.uint8)
    assert SeenBlocks(seen, lattice).packed() == bytes([0b1, 0b10])


@pytest.mark.parametrize("shape", [(4, 4, 4), (5, 3, 7), (1, 1, 1), (2, 1, 9)])
def test_a_coarser_block_is_seen_if_all_its_parts_are(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(0)
    fine = SeenBlocks((rng.random(int(np.prod(shape))) < 0.9).astype(np.uint8), Lattice((-1, 2, 0), 0.1, shape))
    coarse = fine.coarser()
    assert coarse.lattice.voxel_size_m == pytest.approx(0.2)
    assert coarse.lattice.origin_m == fine.lattice.origin_m
    parts = fine.seen.reshape(shape)
    for x, y, z in np.ndindex(coarse.lattice.shape):
        part = parts[2 * x : 2 * x + 2, 2 * y : 2 * y + 2, 2 * z : 2 * z + 2]
        assert part.size > 0
        assert coarse.seen.reshape(coarse.lattice.shape)[x, y, z] == part.min()


@pytest.mark.parametrize("size_m", [30.0, 150.0])
def test_a_large_cell_has_larger_blocks(size_m: float) -> None:
    """150 m in blocks of 5 cm would be 27e9 of them."""
    visibility = Visibility(CAMERA, ABOVE, np.zeros(3), np.full(3, size_m), 0.05, 0.9, 0.0)
    assert visibility.lattice.cell_count <= MAX_BLOCKS
    assert visibility.lattice.voxel_size_m * min(visibility.lattice.shape) >= size_m - 1e-6
