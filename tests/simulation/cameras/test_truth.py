# SPDX-License-Identifier: Apache-2.0
"""Truth against slow twins in plain numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shared.camera import Intrinsics
from shared.lattice import Lattice
from shared.transforms import Transform, apply, identity, inverse, look_at
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.cameras.depth_noise import DepthNoise
from simulation.cameras.truth import NOISE_SIGMAS, TruthFinder, false_voxels, has_near, missed_voxels
from simulation.world.scene import Owner, View
from simulation.world.world import World

CAMERA = Intrinsics(64, 48, 60.0, 58.0, 31.2, 24.1)
LATTICE = Lattice((-0.8, -0.7, 0.2), 0.1, (16, 14, 18))


def random_view(seed: int) -> View:
    """Return a view with flat patches of all owners at random depths."""
    rng = np.random.default_rng(seed)
    z_m = np.kron(rng.uniform(0.4, 2.2, (6, 8)), np.ones((8, 8))) + rng.uniform(0.0, 0.03, CAMERA.shape)
    owner = np.kron(rng.choice([int(owner) for owner in Owner], (6, 8)), np.ones((8, 8), dtype=np.uint8))
    z_m[owner == Owner.NOTHING] = np.inf
    return View(z_m.astype(np.float32), owner.astype(np.uint8))


def points_world(z_m: NDArray[Any], pose: Transform) -> NDArray[np.float64]:
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    points = np.empty((*CAMERA.shape, 3))
    points[..., 0] = (u - CAMERA.cx) / CAMERA.fx * z_m
    points[..., 1] = (v - CAMERA.cy) / CAMERA.fy * z_m
    points[..., 2] = z_m
    return apply(pose, points)


@pytest.mark.parametrize("seed", range(4))
def test_visible_voxels_equal_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    view = random_view(seed)
    pose = look_at((0.1, 0.05, -0.1), (0.0, 0.0, 1.0), (0.1, -1.0, 0.0))
    limit_m = np.where(rng.random(CAMERA.shape) < 0.5, view.z_m + 0.01, view.z_m - 0.01).astype(np.float32)
    limit_m[:8] = np.inf
    truth = TruthFinder(CAMERA, pose, LATTICE, DepthNoise()).find(view, limit_m)

    unknown = view.owner >= Owner.PERSON
    z_m = np.where(unknown, view.z_m.astype(np.float64), 1.0)
    indices = LATTICE.index(points_world(z_m, pose))
    counted = unknown & LATTICE.contains(indices)
    total, beyond = np.zeros(LATTICE.cell_count), np.zeros(LATTICE.cell_count)
    np.add.at(total, LATTICE.keys(indices[counted]), 1)
    np.add.at(beyond, LATTICE.keys(indices[counted & (view.z_m < limit_m)]), 1)
    centres = LATTICE.centres(LATTICE.indices(np.arange(LATTICE.cell_count)))
    depth_m = apply(inverse(pose), centres)[:, 2]
    enough = 0.1 * CAMERA.fx * CAMERA.fy * (LATTICE.voxel_size_m / np.maximum(depth_m, 1e-3)) ** 2
    expected = np.flatnonzero((total > 0) & (total >= enough))
    np.testing.assert_array_equal(truth.visible_keys, expected)
    np.testing.assert_array_equal(truth.visible_counts, total[expected])
    outside = (beyond > 0) & (beyond >= enough)
    np.testing.assert_array_equal(truth.outside_keys, np.flatnonzero(outside))
    np.testing.assert_array_equal(truth.margin_keys, expected[~outside[expected]])
    assert 0 < len(truth.margin_keys) < len(expected)


@pytest.mark.parametrize("seed", range(3))
def test_surface_voxels_contain_the_true_points_and_extend_along_the_rays_by_the_noise(seed: int) -> None:
    view, noise = random_view(seed), DepthNoise()
    truth = TruthFinder(CAMERA, identity(), LATTICE, noise).find(view)
    unknown = view.owner >= Owner.PERSON
    z_m = np.where(unknown, view.z_m.astype(np.float64), 1.0)
    reach_m = NOISE_SIGMAS * noise.sigma_of(z_m, CAMERA)
    inner: set[int] = set()
    outer: set[int] = set()
    for share in np.linspace(-1.0, 1.0, 81):
        for scale, keys in ((0.99, inner), (1.35, outer)):
            indices = LATTICE.index(points_world(z_m + scale * share * reach_m, identity()))
            keys |= set(LATTICE.keys(indices[unknown & LATTICE.contains(indices)]).tolist())
    found = set(truth.surface_keys.tolist())
    assert found <= outer
    # Its coarser steps may pass over a corner of a voxel, which then has neighbours that are found.
    missing = np.array(sorted(inner - found), dtype=np.uint32)
    assert len(missing) < 0.15 * len(inner)
    assert has_near(missing, truth.surface_keys, LATTICE, 1).all()
    indices = LATTICE.index(points_world(z_m, identity()))
    assert set(LATTICE.keys(indices[unknown & LATTICE.contains(indices)]).tolist()) <= found


def test_without_noise_the_surface_consists_of_the_points_voxels() -> None:
    view = random_view(5)
    truth = TruthFinder(CAMERA, identity(), LATTICE, DepthNoise.none()).find(view)
    assert set(truth.visible_keys.tolist()) <= set(truth.surface_keys.tolist())
    indices = LATTICE.index(points_world(np.where(view.owner >= Owner.PERSON, view.z_m, 1.0), identity()))
    inside = (view.owner >= Owner.PERSON) & LATTICE.contains(indices)
    np.testing.assert_array_equal(truth.surface_keys, np.unique(LATTICE.keys(indices[inside])))


def test_a_second_search_gives_the_same_result() -> None:
    finder = TruthFinder(CAMERA, identity(), LATTICE, DepthNoise())
    first = finder.find(random_view(1))
    finder.find(random_view(2))
    again = finder.find(random_view(1))
    np.testing.assert_array_equal(first.surface_keys, again.surface_keys)
    np.testing.assert_array_equal(first.visible_keys, again.visible_keys)


def test_without_unknown_objects_nothing_is_visible() -> None:
    view = View(np.full(CAMERA.shape, 1.0, np.float32), np.full(CAMERA.shape, Owner.ROBOT, np.uint8))
    truth = TruthFinder(CAMERA, identity(), LATTICE, DepthNoise()).find(view)
    assert not len(truth.visible_keys)
    assert not len(truth.surface_keys)
    assert not len(truth.outside_keys)


@pytest.mark.parametrize("reach", [0, 1, 2])
def test_nearness_equals_the_twin(reach: int) -> None:
    rng = np.random.default_rng(reach)
    keys = rng.choice(LATTICE.cell_count, 200, replace=False).astype(np.uint32)
    others = rng.choice(LATTICE.cell_count, 40, replace=False).astype(np.uint32)
    distance = np.abs(LATTICE.indices(keys)[:, None].astype(int) - LATTICE.indices(others)[None].astype(int)).max(
        axis=-1
    )
    np.testing.assert_array_equal(has_near(keys, others, LATTICE, reach), (distance <= reach).any(axis=1))
    expected = keys[(distance > reach).all(axis=1)]
    np.testing.assert_array_equal(false_voxels(keys, others, LATTICE, reach), expected)
    np.testing.assert_array_equal(missed_voxels(keys, others, LATTICE, reach), expected)
    assert not has_near(keys, np.empty(0, dtype=np.uint32), LATTICE, reach).any()


def test_voxels_of_measured_people_are_not_false_and_their_visible_ones_not_missed() -> None:
    world = World.demo(people=1, seed=2)
    camera = SimulatedCamera(world, rig(world.cell, 1)[0], d435i_intrinsics(424, 240))
    lattice = world.cell.lattice(0.05)
    frame = camera.capture(3.0)
    truth = TruthFinder(camera.intrinsics, camera.T_world_camera, lattice, camera.noise).find(frame.view)
    assert len(truth.visible_keys) > 50
    # The camera's measurement of the person, with all faults except those at the rim.
    z_m = frame.depth * camera.intrinsics.depth_scale_m
    on_person = (frame.owner == Owner.PERSON) & (np.abs(z_m - frame.true_z_m) < 0.1) & (frame.depth > 0)
    indices = lattice.index(apply(camera.T_world_camera, camera.intrinsics.deproject(frame.depth))[on_person])
    reported = np.unique(lattice.keys(indices[lattice.contains(indices)]))
    assert len(false_voxels(reported, truth.surface_keys, lattice)) == 0
    assert len(missed_voxels(truth.visible_keys, reported, lattice)) <= 0.02 * len(truth.visible_keys)
    elsewhere = lattice.keys(np.array([[2, 2, 40], [3, 3, 40]]))
    assert len(false_voxels(elsewhere, truth.surface_keys, lattice)) == 2
    assert len(missed_voxels(truth.visible_keys, elsewhere, lattice)) == len(truth.visible_keys)
