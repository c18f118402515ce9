# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geometry.kernels.bundles import plain
from geometry.kernels.foreground import foreground_mask
from geometry.kernels.limits import Band

RAW_MAX = 65535
EDGES = np.array([0, 1, 2, 149, 150, 151, 999, 1000, 1001, 32767, 32768, 65534, 65535], np.uint16)


def no_robot_in(shape: tuple[int, int]) -> NDArray[np.int32]:
    return np.zeros((shape[0], 2), np.int32)


def everywhere(shape: tuple[int, int]) -> NDArray[np.int32]:
    return np.tile(np.array((0, shape[1]), np.int32), (shape[0], 1))


Image = NDArray[np.uint16]


def twin(
    depth: Image, limit: Image, near: Image, span: Image, robot_columns: NDArray[np.int32], minimum: int
) -> NDArray[np.bool_]:
    """Compute the filter in wide integers: measured, in range, nearer than static surfaces, and not robot."""
    d, static, low = depth.astype(np.int64), limit.astype(np.int64), near.astype(np.int64)
    high = low + span
    v, u = np.mgrid[0 : d.shape[0], 0 : d.shape[1]]
    looked_at = (u >= robot_columns[v, 0]) & (u < robot_columns[v, 1])
    robot = looked_at & (low <= d) & (d <= high)
    return np.asarray((d > 0) & (d >= minimum) & (d < static) & ~robot)


def run(
    depth: Image, limit: Image, near: Image, span: Image, robot_columns: NDArray[np.int32], minimum: int = 1
) -> NDArray[np.bool_]:
    height, width = depth.shape
    mask = np.full((height, -(-width // 8) * 8), 9, np.uint8)
    mask[:, width:] = 0
    room = (np.maximum(limit.astype(np.int64), minimum) - minimum).astype(np.uint16)
    foreground_mask(depth, room, minimum, plain(Band(near, span, robot_columns)), mask)
    assert (mask[:, width:] == 0).all()
    assert (mask <= 1).all()
    return mask[:, :width].astype(np.bool_)


def no_robot(shape: tuple[int, int]) -> tuple[Image, Image]:
    return np.full(shape, RAW_MAX, np.uint16), np.zeros(shape, np.uint16)


@pytest.mark.parametrize("minimum", [1, 150, 40000, RAW_MAX])
@pytest.mark.parametrize("width", [1, 7, 8, 61, 424])
def test_marks_the_same_pixels_as_the_twin(width: int, minimum: int) -> None:
    rng = np.random.default_rng(width)
    shape = (23, width)
    depth, limit, near = (rng.integers(0, RAW_MAX, shape, np.uint16, endpoint=True) for _ in range(3))
    depth[rng.random(shape) < 0.2] = 0
    span = np.minimum(rng.integers(0, 9000, shape), RAW_MAX - near.astype(int)).astype(np.uint16)
    absent = rng.random(shape) < 0.5
    near[absent], span[absent] = RAW_MAX, 0
    columns = np.sort(rng.integers(0, width + 1, (23, 2)), axis=1).astype(np.int32)
    columns[:3] = 0
    mask = run(depth, limit, near, span, columns, minimum)
    assert (mask == twin(depth, limit, near, span, columns, minimum)).all()


def test_every_combination_of_edge_values() -> None:
    depth, limit, near, high = (grid.reshape(-1, 13) for grid in np.meshgrid(EDGES, EDGES, EDGES, EDGES))
    span = np.where(high > near, high - near, 0).astype(np.uint16)
    columns = everywhere(depth.shape)
    for minimum in (1, 2, 150, 1000, RAW_MAX):
        mask = run(depth, limit, near, span, columns, minimum)
        assert (mask == twin(depth, limit, near, span, columns, minimum)).all()


def test_depth_0_is_never_foreground() -> None:
    shape = (5, 11)
    far = np.full(shape, RAW_MAX, np.uint16)
    assert not run(np.zeros(shape, np.uint16), far, *no_robot(shape), no_robot_in(shape)).any()


def test_a_limit_of_0_hides_everything() -> None:
    shape = (5, 11)
    depth = np.random.default_rng(0).integers(0, RAW_MAX, shape, np.uint16, endpoint=True)
    assert not run(depth, np.zeros(shape, np.uint16), *no_robot(shape), no_robot_in(shape)).any()


def test_without_a_robot_its_images_are_not_read() -> None:
    shape = (5, 11)
    depth, far = np.full(shape, 1000, np.uint16), np.full(shape, RAW_MAX, np.uint16)
    band = np.zeros(shape, np.uint16), far
    assert run(depth, far, *band, no_robot_in(shape)).all()


def test_the_robot_is_two_sided() -> None:
    depth = np.array([[899, 900, 1000, 1250, 1251, 2000]], np.uint16)
    far = np.full_like(depth, RAW_MAX)
    near, span = np.full_like(depth, 900), np.full_like(depth, 350)
    mask = run(depth, far, near, span, everywhere((1, 6)))
    assert mask.tolist() == [[True, False, False, False, True, True]]
