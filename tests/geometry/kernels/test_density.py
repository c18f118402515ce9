# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from geometry.kernels.bundles import plain
from geometry.kernels.density import (
    AT_ONCE,
    Kept,
    Rule,
    View,
    expected_angular,
    expected_pinhole,
    keep_dense,
    locate,
    neighbourhood_count,
)
from shared.lattice import Lattice
from shared.transforms import Transform, apply, from_xyz_rpy, inverse

FX, FY = 320.0, 310.0
DEGREES_PER_COLUMN, DEGREES_PER_ROW = 69.0 / 424.0, 42.0 / 240.0


def view_of(lattice: Lattice, T_world_camera: Transform) -> View:
    T_camera_world = inverse(T_world_camera)
    return plain(
        View(
            np.array(lattice.shape, np.int32),
            lattice.voxel_size_m,
            apply(T_camera_world, lattice.centres(np.zeros(3))),
            np.ascontiguousarray(T_camera_world[:3, :3] * lattice.voxel_size_m),
            FX,
            FY,
            DEGREES_PER_COLUMN,
            DEGREES_PER_ROW,
        )
    )


def kept(
    counts: NDArray[np.uint32],
    lattice: Lattice,
    T_world_camera: Transform,
    angular: bool = False,
    single: bool = False,
    threshold: float = 0.75,
    own_share_min: float = 0.05,
    area_max_m2: float = 0.0025,
    points_min: float = 0.0,
) -> set[int]:
    rimmed = np.pad(counts, 1)
    slots = np.flatnonzero(rimmed).astype(np.uint32)
    # One more slot for points outside the lattice, which do not count.
    memory = np.append(rimmed.ravel(), np.uint32(10**6)).astype(np.uint32)
    keys, kept_counts = (np.full(len(slots) + 1, 0xFFFFFFFF, np.uint32) for _ in range(2))
    number = keep_dense(
        memory,
        slots,
        len(slots),
        view_of(lattice, T_world_camera),
        plain(Rule(angular, single, threshold, own_share_min, area_max_m2, points_min)),
        plain(Kept(keys, kept_counts, np.empty((6, AT_ONCE)), np.empty(AT_ONCE, np.uint32))),
    )
    assert (np.diff(keys[:number].astype(np.int64)) > 0).all(), "in the order of the slots"
    assert (kept_counts[:number] == counts.ravel()[keys[:number]]).all()
    return set(keys[:number].tolist())


def twin(
    counts: NDArray[np.uint32],
    lattice: Lattice,
    T_world_camera: Transform,
    angular: bool,
    single: bool,
    threshold: float,
    own_share_min: float,
    area_max_m2: float,
    points_min: float,
) -> set[int]:
    """Judge all voxels at once, with scipy's convolution for the neighbourhood."""
    size_m = lattice.voxel_size_m
    centre_m = apply(inverse(T_world_camera), lattice.centres(np.moveaxis(np.indices(lattice.shape), 0, -1)))
    if angular:
        distance_m = np.maximum(np.linalg.norm(centre_m, axis=-1), 1e-3)
        degrees = np.degrees(np.arctan(size_m / distance_m))
        full = degrees / DEGREES_PER_COLUMN * (degrees / DEGREES_PER_ROW)
    else:
        full = FX * FY * (size_m / np.maximum(centre_m[..., 2], 1e-3)) ** 2
    if single:
        dense = counts >= threshold * full
    else:
        around = ndimage.convolve(counts.astype(np.int64), np.ones((3, 3, 3), np.int64), mode="constant")
        share = min(area_max_m2 / size_m**2, 1.0)
        needed = np.maximum(threshold * share * full, np.minimum(points_min, 3.0 * full))
        dense = (around >= needed) & (counts >= own_share_min * full)
    return set(np.nonzero((dense & (counts > 0)).ravel())[0].tolist())


@pytest.mark.parametrize("angular", [False, True])
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("size_m", [0.01, 0.05, 0.1])
@pytest.mark.parametrize("shape", [(12, 9, 7), (1, 1, 1), (40, 1, 2), (3, 170, 4)])
def test_keeps_the_same_voxels_as_the_twin(
    angular: bool, single: bool, size_m: float, shape: tuple[int, int, int]
) -> None:
    rng = np.random.default_rng(sum(shape) + int(1000 * size_m))
    lattice = Lattice((-0.3, 0.1, -0.2), size_m, shape)
    sizes = []
    for _ in range(6):
        # For voxels behind the camera the full count is 0, so any count is enough.
        pose = from_xyz_rpy(rng.normal(0.0, 0.6, 3), rng.uniform(-np.pi, np.pi, 3))
        z_m = apply(inverse(pose), lattice.centres(np.moveaxis(np.indices(shape), 0, -1)))[..., 2]
        full = FX * FY * (size_m / np.maximum(np.abs(z_m), 0.1)) ** 2
        counts = rng.poisson(full * rng.uniform(0.0, 2.0, shape) * (rng.random(shape) < 0.5)).astype(np.uint32)
        figures = (rng.uniform(0.05, 1.5), rng.uniform(0.0, 0.2), rng.uniform(1e-4, 0.01), rng.uniform(0, 80))
        wanted = twin(counts, lattice, pose, angular, single, *figures)
        assert kept(counts, lattice, pose, angular, single, *figures) == wanted
        sizes.append(len(wanted) / max(np.count_nonzero(counts), 1))
    assert shape == (1, 1, 1) or 0.05 < np.mean(sizes) < 1.0


def test_nothing_touched() -> None:
    lattice = Lattice((0, 0, 0), 0.05, (4, 5, 6))
    assert kept(np.zeros(lattice.shape, np.uint32), lattice, from_xyz_rpy((0, 0, -1), (0, 0, 0))) == set()


def test_the_neighbourhood_ends_at_the_lattice() -> None:
    """The end of a row is not a neighbour of the next row's first voxel."""
    shape = (3, 4, 5)
    counts = np.random.default_rng(0).integers(0, 9, shape).astype(np.uint32)
    around = ndimage.convolve(counts.astype(int), np.ones((3, 3, 3), int), mode="constant")
    rimmed = np.pad(counts, 1)
    per_y, per_x = np.uint64(rimmed.shape[2]), np.uint64(rimmed.shape[1] * rimmed.shape[2])
    for index in np.ndindex(shape):
        slot = np.ravel_multi_index(tuple(np.array(index) + 1), rimmed.shape)
        assert neighbourhood_count(rimmed.ravel(), np.uint64(slot), per_y, per_x) == around[index]


@pytest.mark.parametrize("shape", [(512, 512, 512), (32767, 1, 4096), (1, 32767, 4096), (4096, 1, 32767), (1, 1, 1)])
def test_slots_of_the_largest_lattices_are_located_exactly(shape: tuple[int, int, int]) -> None:
    """In floating point, since vectors of integers cannot be divided; critical are the first and last slot of a row."""
    rng = np.random.default_rng(0)
    index = rng.integers(0, shape, (3000, 3))
    index[:1000] = np.where(rng.random((1000, 3)) < 0.5, 0, np.array(shape) - 1)
    _, ny, nz = shape
    slots = ((index[:, 0] + 1) * (ny + 2) + index[:, 1] + 1) * (nz + 2) + index[:, 2] + 1
    keys, z_m, distance_m = np.empty(3000, np.uint32), np.empty(3000), np.empty(3000)
    first_m, axes = np.array((0.1, -0.2, 0.3)), rng.normal(0.0, 0.01, (3, 3))
    view = plain(View(np.array(shape, np.int32), 0.01, first_m, axes, FX, FY, DEGREES_PER_COLUMN, DEGREES_PER_ROW))
    locate(slots.astype(np.uint32), view, keys, z_m, distance_m)
    assert (keys == (index[:, 0] * ny + index[:, 1]) * nz + index[:, 2]).all()
    centres_m = first_m + index @ axes.T
    assert np.allclose(z_m, centres_m[:, 2])
    assert np.allclose(distance_m, np.linalg.norm(centres_m, axis=1))


def test_a_hand_on_a_border_survives_here_and_not_in_the_paper() -> None:
    """Two layers of 45 % each: alone both are noise, together they are a hand."""
    lattice = Lattice((-0.25, -0.25, 1.4), 0.05, (10, 10, 4))
    pose = from_xyz_rpy((0, 0, 0), (0, 0, 0))
    counts = np.zeros(lattice.shape, np.uint32)
    counts[4:6, 4:6, 1:3] = round(0.45 * FX * FY * (0.05 / 1.5) ** 2)
    assert len(kept(counts, lattice, pose)) == 8
    assert kept(counts, lattice, pose, single=True, threshold=0.5) == set()


def test_own_share_removes_stray_points_beside_a_surface() -> None:
    lattice = Lattice((-0.25, -0.25, 1.4), 0.05, (10, 10, 4))
    counts = np.zeros(lattice.shape, np.uint32)
    counts[5, 5, 2], counts[5, 6, 2] = 120, 3
    assert len(kept(counts, lattice, from_xyz_rpy((0, 0, 0), (0, 0, 0)))) == 1


def test_large_voxels_never_require_more_than_a_hand() -> None:
    lattice = Lattice((-0.5, -0.5, 1.0), 0.1, (10, 10, 10))
    counts = np.zeros(lattice.shape, np.uint32)
    full = FX * FY * (0.1 / 1.55) ** 2
    counts[5, 5, 5] = math.ceil(0.25 * full)
    pose = from_xyz_rpy((0, 0, 0), (0, 0, 0))
    assert len(kept(counts, lattice, pose, threshold=0.95)) == 1
    assert len(kept(counts, lattice, pose, threshold=0.95, area_max_m2=0.01)) == 0


def test_few_points_are_noise_at_any_distance() -> None:
    """At 5 m a voxel of 5 cm is full with ten points, and one wrong match has more."""
    lattice = Lattice((-0.5, -0.5, 4.5), 0.05, (20, 20, 20))
    pose = from_xyz_rpy((0, 0, 0), (0, 0, 0))
    counts = np.zeros(lattice.shape, np.uint32)
    counts[9:11, 9, 9] = 11
    assert len(kept(counts, lattice, pose)) == 2
    assert kept(counts, lattice, pose, points_min=40) == set()
    # A wall still shows three full voxels.
    counts[8:12, 8:12, 9] = 10
    assert len(kept(counts, lattice, pose, points_min=40)) == 16


def test_the_least_number_of_points_does_not_affect_small_voxels() -> None:
    """At 3 m a voxel of 1 cm is full with one point: no neighbourhood ever holds forty."""
    lattice = Lattice((-0.1, -0.1, 2.9), 0.01, (20, 20, 20))
    counts = np.zeros(lattice.shape, np.uint32)
    counts[5:15, 5:15, 10] = 1
    assert len(kept(counts, lattice, from_xyz_rpy((0, 0, 0), (0, 0, 0)), points_min=40)) == 100


def test_expected_counts() -> None:
    # A pinhole camera of f = 424 px sees a square of 5 cm at 1 m as 21.2 px.
    assert expected_pinhole(0.05, 1.0, 424.0, 424.0) == pytest.approx(21.2**2)
    # The paper: 640x480 and 75 x 62 degrees, 5 cm at 1 m are 2.8624 degrees, 24.4 columns by 22.2 rows.
    assert expected_angular(0.05, 1.0, 75.0 / 640.0, 62.0 / 480.0) == pytest.approx(541.0, rel=2e-3)
    assert math.isfinite(expected_pinhole(0.05, 0.0, 424.0, 424.0))
    assert math.isfinite(expected_angular(0.05, 0.0, 0.1, 0.1))
