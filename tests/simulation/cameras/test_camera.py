# SPDX-License-Identifier: Apache-2.0
"""Cameras in the world: equal frames in all processes, and rigs of any size."""

from __future__ import annotations

import math

import numpy as np
import pytest

from shared.errors import InputError
from shared.transforms import apply, inverse, validated
from simulation.cameras.camera import MAX_RIG, SimulatedCamera, d435i_intrinsics, rig
from simulation.cameras.depth_noise import DepthNoise
from simulation.world.scene import Owner
from simulation.world.world import World


@pytest.fixture(scope="module")
def world() -> World:
    return World.demo(people=2, seed=3)


def test_equal_cameras_take_equal_frames_in_any_order(world: World) -> None:
    pose = rig(world.cell, 4)[2]
    first = SimulatedCamera(world, pose, d435i_intrinsics(424, 240), seed=9)
    second = SimulatedCamera(World.demo(people=2, seed=3, cell=world.cell), pose, d435i_intrinsics(424, 240), seed=9)
    first.capture(1.0)
    ours, theirs = first.capture(2.5), second.capture(2.5)
    np.testing.assert_array_equal(ours.depth, theirs.depth)
    np.testing.assert_array_equal(ours.true_z_m, theirs.true_z_m)
    np.testing.assert_array_equal(ours.owner, theirs.owner)
    np.testing.assert_array_equal(ours.joints, world.joints_at(2.5))
    assert (first.capture(2.5 + 1.0 / 15.0).depth != ours.depth).mean() > 0.5


def test_both_renderers_give_nearly_the_same_measurement(world: World) -> None:
    pose = rig(world.cell, 1)[0]
    one, other = (
        SimulatedCamera(world, pose, d435i_intrinsics(424, 240), DepthNoise.none(), name).capture(4.0).depth
        for name in ("raster", "raycast")
    )
    assert (np.abs(one.astype(int) - other.astype(int)) <= 2).mean() > 0.99


@pytest.mark.parametrize("size", [(424, 240), (640, 480), (848, 480), (1280, 720)])
def test_profiles_are_as_wide_as_a_d435i(size: tuple[int, int]) -> None:
    camera = d435i_intrinsics(*size)
    width_deg = 2.0 * math.degrees(math.atan(0.5 * camera.width / camera.fx))
    assert camera.shape == size[::-1]
    assert width_deg == pytest.approx(79.0 if size == (640, 480) else 89.0, abs=2.0)


def test_unknown_profiles_and_rig_sizes_are_refused(world: World) -> None:
    with pytest.raises(InputError, match="expected one of 424x240"):
        d435i_intrinsics(100, 100)
    for count in (0, MAX_RIG + 1):
        with pytest.raises(InputError, match="cameras: expected 1 to 50"):
            rig(world.cell, count)


def test_a_rig_sees_the_cell_from_different_positions(world: World) -> None:
    poses = rig(world.cell, MAX_RIG)
    for pose in poses:
        validated(pose, "pose")
        assert (np.abs(pose[:2, 3]) <= 1.65 + 1e-9).all()
        assert (np.abs(pose[:2, 3]) > 1.5).any()
        in_camera = apply(inverse(pose), np.array((0.0, 0.0, 0.15)))
        np.testing.assert_allclose(in_camera[:2], 0.0, atol=1e-9)
        assert in_camera[2] > 0.0
    places = np.array([pose[:3, 3] for pose in poses])
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9.0 * np.eye(len(places))
    assert apart.min() > 0.15
    np.testing.assert_array_equal(rig(world.cell, 4), poses[:4])
    assert {tuple(np.sign(place[:2])) for place in places[:4]} == {(-1, -1), (1, 1), (1, -1), (-1, 1)}


def test_four_cameras_together_see_all_owners(world: World) -> None:
    seen: set[int] = set()
    for pose in rig(world.cell, 4):
        frame = SimulatedCamera(world, pose, d435i_intrinsics(424, 240)).capture(0.0)
        seen |= set(np.unique(frame.owner).tolist())
        assert (frame.depth > 0).mean() > 0.85
        assert (frame.owner == Owner.ROBOT).sum() > 50
    assert seen == {Owner.STATIC, Owner.OBJECT, Owner.ROBOT, Owner.ROOM, Owner.PERSON}
