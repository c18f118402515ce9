# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.pipeline import Voxels
from edge_unit.pipeline.edge_halo import EdgeHalo
from edge_unit.pipeline.expected_depth import RobotLayer
from edge_unit.pipeline.stage_times import StageRunner
from edge_unit.pipeline.voxelizer import Voxelizer
from shared.camera import Intrinsics
from shared.lattice import Lattice
from shared.settings import FilterSettings
from shared.transforms import Transform, apply, look_at
from tests.edge_unit.scenes import Depth, camera

DOUBT_M = 2e-5
"""The kernel works in float32: this close to a border a point may fall on either side."""

KEEP_ALL = FilterSettings(occupancy_threshold=0.05, own_share_min=0.0, support_area_max_m2=1e-4, support_points_min=0)


def run(voxelizer: Voxelizer, depth: Depth, mask: NDArray[np.bool_]) -> Voxels:
    """Nothing is before the camera: all marked pixels are foreground."""
    intrinsics = camera(depth.shape[1], depth.shape[0])
    room = np.where(mask, np.uint16(65535), np.uint16(0))
    nobody = RobotLayer(intrinsics, None, 0.05)
    return voxelizer.voxels(depth, room, 1, nobody, EdgeHalo(intrinsics), StageRunner())


def points_m(intrinsics: Intrinsics, T_world_camera: Transform, depth: Depth) -> NDArray[np.float64]:
    return apply(T_world_camera, intrinsics.deproject(depth))


def counts(lattice: Lattice, points: NDArray[np.float64]) -> dict[int, int]:
    """The same by the lattice's own arithmetic, in float64."""
    index = lattice.index(points)
    keys, number = np.unique(lattice.keys(index[lattice.contains(index)]), return_counts=True)
    return dict(zip(keys.tolist(), number.tolist(), strict=True))


@pytest.mark.parametrize("size_m", [0.01, 0.05, 0.1])
@pytest.mark.parametrize("width", [61, 160])
def test_counts_are_those_of_the_lattice(width: int, size_m: float) -> None:
    """The camera's own deprojection, the pose and `Lattice.index`, on points with negative coordinates, too."""
    rng = np.random.default_rng(width)
    intrinsics, T_world_camera = camera(width, 91), look_at((0.4, -0.7, 1.6), (0.0, 0.1, 0.0))
    lattice = Lattice.covering((-0.7, -0.8, -0.3), (0.6, 0.9, 0.7), size_m)
    # Every touched voxel is kept: a full count times these shares is below one point.
    settings = KEEP_ALL.model_copy(update={"voxel_size_m": size_m, "occupancy_threshold": 1e-9})
    voxelizer = Voxelizer(intrinsics, T_world_camera, lattice, settings)
    for _ in range(3):
        depth = rng.integers(600, 2600, intrinsics.shape).astype(np.uint16)
        points = points_m(intrinsics, T_world_camera, depth)
        off_border = np.abs((points - lattice.origin_m) / size_m - np.rint((points - lattice.origin_m) / size_m))
        mask = (rng.random(depth.shape) < 0.7) & (off_border > DOUBT_M / size_m).all(axis=-1)
        voxels = run(voxelizer, depth, mask)
        assert dict(zip(voxels.keys.tolist(), voxels.counts.tolist(), strict=True)) == counts(lattice, points[mask])


def test_voxels_are_sorted_and_typed() -> None:
    intrinsics = camera(160, 90)
    lattice = Lattice.covering((-1, -1, -0.2), (1, 1, 1.8), 0.05)
    voxelizer = Voxelizer(intrinsics, look_at((0.3, 0.2, 1.7), (0, 0, 0)), lattice, FilterSettings())
    voxels = run(voxelizer, np.full(intrinsics.shape, 1200, np.uint16), np.ones(intrinsics.shape, np.bool_))
    assert len(voxels) > 100
    assert voxels.keys.dtype == np.uint32
    assert (np.diff(voxels.keys.astype(np.int64)) > 0).all()
    assert voxels.counts.dtype == np.uint32
    assert voxels.counts.min() > 0
    assert voxels.indices.dtype == np.int16
    assert voxels.indices.shape == (len(voxels), 3)
    assert (voxels.lattice.keys(voxels.indices) == voxels.keys).all()
    assert voxels.lattice.centres(voxels.indices).shape == (len(voxels), 3)


def test_one_frame_leaves_nothing_for_the_next() -> None:
    intrinsics = camera(160, 90)
    lattice = Lattice.covering((-1, -1, -0.2), (1, 1, 1.8), 0.05)
    voxelizer = Voxelizer(intrinsics, look_at((0.3, 0.2, 1.7), (0, 0, 0)), lattice, FilterSettings())
    depth = np.random.default_rng(0).integers(500, 1800, intrinsics.shape).astype(np.uint16)
    every = np.ones(intrinsics.shape, np.bool_)
    first = run(voxelizer, depth, every)
    assert len(run(voxelizer, depth, ~every)) == 0
    again = run(voxelizer, depth, every)
    assert (again.keys == first.keys).all()
    assert (again.counts == first.counts).all()


def test_a_returned_result_is_not_overwritten() -> None:
    intrinsics = camera(160, 90)
    lattice = Lattice.covering((-1, -1, -0.2), (1, 1, 1.8), 0.05)
    voxelizer = Voxelizer(intrinsics, look_at((0.3, 0.2, 1.7), (0, 0, 0)), lattice, FilterSettings())
    every = np.ones(intrinsics.shape, np.bool_)
    first = run(voxelizer, np.full(intrinsics.shape, 1200, np.uint16), every)
    keys, number = first.keys.copy(), first.counts.copy()
    run(voxelizer, np.full(intrinsics.shape, 900, np.uint16), every)
    assert (first.keys == keys).all()
    assert (first.counts == number).all()


def test_a_moved_camera_reports_the_same_objects_at_the_same_positions() -> None:
    intrinsics = camera(160, 90)
    lattice = Lattice.covering((-1, -1, -0.2), (1, 1, 1.8), 0.05)
    voxelizer = Voxelizer(intrinsics, np.eye(4), lattice, FilterSettings())
    assert lattice.shape == (40, 40, 40)
    T_world_camera = look_at((0.0, 0.0, 1.625), (0.0, 0.0, 0.0))
    voxelizer.place(T_world_camera)
    voxels = run(voxelizer, np.full(intrinsics.shape, 1000, np.uint16), np.ones(intrinsics.shape, np.bool_))
    z_m = lattice.centres(voxels.indices)[:, 2]
    assert np.abs(z_m - 0.625).max() <= 0.026
    fresh = Voxelizer(intrinsics, T_world_camera, lattice, FilterSettings())
    other = run(fresh, np.full(intrinsics.shape, 1000, np.uint16), np.ones(intrinsics.shape, np.bool_))
    assert (other.keys == voxels.keys).all()


# ---------------------------------------------------------------- the density rule


def plate(intrinsics: Intrinsics, z_m: float, side_m: float, shift_m: tuple[float, float] = (0, 0)) -> Depth:
    """A square that faces the camera; nothing else is measured."""
    v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
    x = (u - intrinsics.cx) / intrinsics.fx * z_m - shift_m[0]
    y = (v - intrinsics.cy) / intrinsics.fy * z_m - shift_m[1]
    inside = (np.abs(x) <= side_m / 2) & (np.abs(y) <= side_m / 2)
    return np.where(inside, round(z_m / intrinsics.depth_scale_m), 0).astype(np.uint16)


def found(settings: FilterSettings, depth: Depth, intrinsics: Intrinsics) -> Voxels:
    lattice = Lattice.covering((-1, -1, 0.2), (1, 1, 3.2), settings.voxel_size_m)
    return run(Voxelizer(intrinsics, np.eye(4), lattice, settings), depth, depth > 0)


@pytest.mark.parametrize("z_m", [1.0, 1.5, 2.0])
def test_a_plate_of_10_cm_is_never_lost_at_the_defaults(z_m: float) -> None:
    """In steps of 5 mm through the depth of two voxels, and across one."""
    intrinsics = camera(424, 240)
    for step_m in np.arange(0.0, 0.1, 0.005):
        depth = plate(intrinsics, z_m + step_m, 0.1, (step_m / 2, step_m / 3))
        assert len(found(FilterSettings(), depth, intrinsics)) > 0


def test_the_papers_own_rule_loses_an_object_on_a_border() -> None:
    intrinsics = camera(848, 480)
    paper = FilterSettings(density_rule="single", density_model="angular", occupancy_threshold=0.6)
    depth = plate(intrinsics, 1.475, 0.05, (0.025, 0.025))  # a full voxel's face, shifted by half of it on two axes
    on_border = plate(intrinsics, 1.475, 0.05)
    assert len(found(paper, depth, intrinsics)) == 1
    assert len(found(paper, on_border, intrinsics)) == 0
    assert len(found(FilterSettings(), on_border, intrinsics)) > 0


@pytest.mark.parametrize("rule", ["neighbourhood", "single"])
@pytest.mark.parametrize("model", ["pinhole", "angular"])
def test_speckle_is_noise_and_a_hand_is_not(rule: str, model: str) -> None:
    intrinsics = camera(848, 480)
    settings = FilterSettings.model_validate({"density_rule": rule, "density_model": model})
    speckle = np.zeros(intrinsics.shape, np.uint16)
    speckle[200:204, 300:305] = 1500
    assert len(found(settings, speckle, intrinsics)) == 0
    assert len(found(settings, plate(intrinsics, 1.5, 0.2), intrinsics)) > 0


def test_the_angular_model_needs_more_points_than_the_pinhole() -> None:
    """In the middle of the image it expects some 30 % more points than there are."""
    intrinsics = camera(848, 480)
    depth = plate(intrinsics, 1.475, 0.05, (0.025, 0.025))
    for model, number in (("pinhole", 1), ("angular", 0)):
        settings = {"density_rule": "single", "density_model": model, "occupancy_threshold": 0.9}
        assert len(found(FilterSettings.model_validate(settings), depth, intrinsics)) == number


def test_the_nearest_of_too_many_are_chosen() -> None:
    lattice = Lattice((0.0, 0.0, 0.0), 0.1, (10, 10, 10))
    keys = np.arange(0, 1000, 3, dtype=np.uint32)
    voxels = Voxels(keys, keys + 1, lattice)
    position_m = np.array((0.2, 0.3, -1.0))
    near, others = voxels.nearest(position_m, 100)
    assert (len(near), len(others)) == (100, len(keys) - 100)
    assert (np.sort(np.concatenate((near.keys, others.keys))) == keys).all()
    assert (np.diff(near.keys.astype(int)) > 0).all()
    assert (near.counts == near.keys + 1).all()

    def distance_m(some: Voxels) -> NDArray[np.float64]:
        return np.asarray(np.linalg.norm(lattice.centres(some.indices) - position_m, axis=1))

    assert distance_m(near).max() <= distance_m(others).min()
    assert len(voxels.nearest(position_m, 10_000)[1]) == 0
