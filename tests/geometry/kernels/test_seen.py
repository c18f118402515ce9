# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from geometry.kernels.bundles import plain
from geometry.kernels.seen import (
    BLOCKED_MAX,
    RAYS_PER_SIDE,
    Blocks,
    Looking,
    Measuring,
    Views,
    block_views,
    seen_blocks,
)
from geometry.rendering.kernel_camera import camera_of
from shared.camera import Intrinsics
from shared.lattice import Lattice
from shared.transforms import Transform, apply, from_xyz_rpy, inverse, look_at

NEAR_M = 0.05
NOISE_PER_M = 0.007
CAMERA = Intrinsics(61, 43, 50.0, 52.0, 29.7, 21.2)
LATTICE = Lattice((-0.6, -0.5, -0.2), 0.1, (12, 10, 5))
ABOVE = look_at((0.1, -0.2, 1.7), (0.0, 0.0, 0.0))


def views(
    lattice: Lattice, T_world_camera: Transform, camera: Intrinsics = CAMERA
) -> tuple[int, NDArray[np.int32], NDArray[np.int32]]:
    blocks = np.full(lattice.cell_count, -1, np.int32)
    rectangles = np.full((lattice.cell_count, 5), -1, np.int32)
    number = block_views(
        plain(Blocks(np.array(lattice.shape, np.int32), lattice.voxel_size_m, np.array(lattice.origin_m))),
        inverse(T_world_camera),
        camera_of(camera),
        plain(Measuring(NEAR_M, NOISE_PER_M, camera.depth_scale_m)),
        plain(Views(blocks, rectangles)),
    )
    return number, blocks, rectangles


def views_twin(lattice: Lattice, T_world_camera: Transform, camera: Intrinsics = CAMERA) -> dict[int, list[int]]:
    found = {}
    for key in range(lattice.cell_count):
        index = lattice.indices(np.array([key]))[0]
        unit = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        corners = apply(inverse(T_world_camera), np.array(lattice.origin_m) + (index + unit) * lattice.voxel_size_m)
        if corners[:, 2].min() < NEAR_M:
            continue
        u, v = camera.project(corners).T
        far_m = corners[:, 2].max()
        far_raw = math.ceil((far_m + NOISE_PER_M * far_m * far_m) / camera.depth_scale_m)
        if u.min() < 0 or v.min() < 0 or u.max() > camera.width - 1 or v.max() > camera.height - 1 or far_raw > 65535:
            continue
        rectangle = (math.floor(v.min()), math.ceil(v.max()), math.floor(u.min()), math.ceil(u.max()))
        found[key] = [*rectangle, far_raw]
    return found


@pytest.mark.parametrize("seed", range(6))
def test_views_equal_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    eye = rng.normal(0.0, 1.0, 3)  # sometimes inside the lattice
    pose = look_at(eye, rng.normal(0.0, 0.3, 3)) @ from_xyz_rpy((0, 0, 0), (0, 0, rng.uniform(-3, 3)))
    number, blocks, rectangles = views(LATTICE, pose)
    wanted = views_twin(LATTICE, pose)
    assert dict(zip(blocks[:number].tolist(), rectangles[:number].tolist(), strict=True)) == wanted


def test_no_block_in_view() -> None:
    away = look_at((0.0, 0.0, 1.7), (0.0, 0.0, 3.0))
    assert views(LATTICE, away)[0] == 0
    seen = np.full(LATTICE.cell_count, 7, np.uint8)
    image = np.full(CAMERA.shape, 65535, np.uint16)
    nothing = views(LATTICE, away)
    seen_blocks(image, image, image, plain(Views(*nothing[1:])), 0, 0.9, plain(Looking(1, np.empty_like(image))), seen)
    assert not seen.any()


def test_blocks_beyond_the_largest_raw_depth_are_not_in_view() -> None:
    fine = Intrinsics(61, 43, 50.0, 52.0, 29.7, 21.2, depth_scale_m=2.5e-5)  # up to 1.64 m
    number, _, rectangles = views(LATTICE, ABOVE, fine)
    assert 0 < number < views(LATTICE, ABOVE)[0]
    assert rectangles[:number, 4].max() <= 65535


def look(
    depth: NDArray[np.uint16], limit: NDArray[np.uint16], robot: NDArray[np.uint16], share: float = 0.9, apart: int = 1
) -> NDArray[np.uint8]:
    number, blocks, rectangles = views(LATTICE, ABOVE)
    seen = np.full(LATTICE.cell_count, 7, np.uint8)
    reach = np.empty((-(-len(depth) // apart), depth.shape[1]), np.uint16)
    seen_blocks(
        depth, limit, robot, plain(Views(blocks, rectangles)), number, share, plain(Looking(apart, reach)), seen
    )
    return seen


def look_twin(
    depth: NDArray[np.uint16], limit: NDArray[np.uint16], robot: NDArray[np.uint16], share: float = 0.9, apart: int = 1
) -> NDArray[np.uint8]:
    seen = np.zeros(LATTICE.cell_count, np.uint8)
    through = np.minimum(np.minimum(depth, limit), robot)[::apart]
    for key, (top, bottom, left, right, far) in views_twin(LATTICE, ABOVE).items():
        top, bottom = top // apart, bottom // apart
        rows = range(top, bottom + 1, max((bottom - top) // RAYS_PER_SIDE, 1))
        columns = range(left, right + 1, max((right - left) // RAYS_PER_SIDE, 1))
        rays = through[np.ix_(rows, columns)]
        blocked = ((rays > 0) & (rays < far)).sum()
        seen[key] = (rays >= far).sum() >= share * rays.size and blocked <= BLOCKED_MAX
    return seen


@pytest.mark.parametrize("share", [0.5, 0.9, 1.0])
@pytest.mark.parametrize("apart", [1, 2, 3])
@pytest.mark.parametrize("seed", range(4))
def test_seen_equals_the_twin(seed: int, apart: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    images = [rng.choice(np.array([0, 1500, 1700, 1900, 65535], np.uint16), CAMERA.shape) for _ in range(3)]
    # Whole regions, since otherwise almost nothing would be seen.
    for image in images:
        image[:, rng.integers(0, 60) :] = 65535
    seen = look(*images, share, apart)
    assert (seen == look_twin(*images, share, apart)).all()


def test_occlusions_of_a_block() -> None:
    far, none = np.full(CAMERA.shape, 65535, np.uint16), np.zeros(CAMERA.shape, np.uint16)
    near = np.full(CAMERA.shape, 100, np.uint16)
    everything = look(far, far, far)
    assert everything.sum() == len(views_twin(LATTICE, ABOVE)) > 50
    assert not look(none, far, far).any(), "unmeasured rays pass nothing"
    assert not look(near, far, far).any(), "what is measured nearer hides"
    assert not look(far, near, far).any(), "what would not be reported behind the static limit is not seen"
    assert not look(far, far, near).any(), "what would not be reported behind the robot is not seen"
    wall = np.full(CAMERA.shape, 1650, np.uint16)
    assert 0 < look(wall, far, far).sum() < everything.sum()


def test_a_block_is_seen_by_rays_that_end_on_its_far_side() -> None:
    far = np.full(CAMERA.shape, 65535, np.uint16)
    key, (*_, far_raw) = next(iter(views_twin(LATTICE, ABOVE).items()))
    for image in range(3):
        images = [far, far, far]
        images[image] = np.full(CAMERA.shape, far_raw, np.uint16)
        assert look(*images)[key] == 1
        images[image] = images[image] - np.uint16(1)
        assert look(*images)[key] == 0


def test_a_share_of_the_rays_may_fail() -> None:
    rng = np.random.default_rng(0)
    far = np.full(CAMERA.shape, 65535, np.uint16)
    holes = np.where(rng.random(CAMERA.shape) < 0.03, 0, far).astype(np.uint16)
    assert look(holes, far, far, 0.5).sum() > look(holes, far, far, 1.0).sum()
