# SPDX-License-Identifier: Apache-2.0
"""Both renderers draw the same true depth, and simple shapes have their analytic depth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from shared.camera import Intrinsics
from shared.meshes import TriangleMesh, box_mesh
from shared.transforms import Transform, from_xyz_rpy, identity, look_at
from simulation.cameras.camera import d435i_intrinsics, rig
from simulation.cameras.raster import RasterRenderer
from simulation.cameras.raycast import RaycastRenderer
from simulation.world.scene import Body, Capsules, Owner, Renderer, Scene
from simulation.world.world import World

SMALL = Intrinsics(97, 61, 60.0, 55.0, 47.3, 29.1)
NO_CAPSULES = Capsules.joined([])
RENDERERS = [RasterRenderer, RaycastRenderer]


def scene_of(*bodies: Body, capsules: Capsules = NO_CAPSULES) -> Scene:
    return Scene((), bodies, capsules)


def rays(camera: Intrinsics) -> NDArray[np.float64]:
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    return np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(camera.shape)), axis=-1)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_tilted_plane(renderer: type[RasterRenderer] | type[RaycastRenderer]) -> None:
    normal, distance_m = np.array((0.3, -0.5, 0.8)), 1.2
    corners = np.array(
        [(x, y, (distance_m - normal[0] * x - normal[1] * y) / normal[2]) for x in (-9, 9) for y in (-9, 9)]
    )
    plane = TriangleMesh("plane", corners.astype(np.float32), np.array(((0, 1, 2), (1, 3, 2))), closed=False)
    view = renderer(SMALL, identity()).render(scene_of(Body("plane", plane, identity(), Owner.STATIC)))
    expected = distance_m / (rays(SMALL) @ normal)
    inside = (expected > 0.1) & (np.abs(rays(SMALL)[..., :2] * expected[..., None]) < 8.9).all(axis=-1)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(view.z_m[inside], expected[inside], rtol=1e-5)
    assert (view.owner[inside] == Owner.STATIC).all()


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_sphere_a_long_capsule_and_one_seen_end_on(renderer: type[RasterRenderer] | type[RaycastRenderer]) -> None:
    capsules = Capsules(
        np.array([[-0.5, 0.0, 1.0], [0.1, -0.3, 1.2], [0.45, 0.1, 0.9]]),
        np.array([[-0.5, 0.0, 1.0], [0.2, 0.3, 1.5], [0.9, 0.2, 1.8]]),
        np.array([0.15, 0.1, 0.12]),
        np.array((4, 5, 6), dtype=np.uint8),
    )
    view = renderer(SMALL, identity()).render(scene_of(capsules=capsules))
    expected = np.full(SMALL.shape, np.inf)
    for z_m in np.linspace(2.2, 0.6, 1601):
        points = rays(SMALL) * z_m
        for a, b, radius in zip(capsules.a_m, capsules.b_m, capsules.radius_m, strict=True):
            share = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-9), 0.0, 1.0)
            expected[np.linalg.norm(points - a - share[..., None] * (b - a), axis=-1) <= radius] = z_m
    both = np.isfinite(expected) & np.isfinite(view.z_m)
    assert both.sum() > 400
    assert (np.isfinite(expected) != np.isfinite(view.z_m)).sum() <= 12
    assert (np.abs(view.z_m[both] - expected[both]) < 0.003).mean() > 0.99
    assert {4, 5, 6} <= set(np.unique(view.owner).tolist())


def pair(camera: Intrinsics, pose: Transform) -> tuple[Renderer, Renderer]:
    return RasterRenderer(camera, pose), RaycastRenderer(camera, pose)


def test_robot_and_furniture_agree_within_a_tenth_of_a_millimetre() -> None:
    world = World.demo(people=0)
    camera = d435i_intrinsics(848, 480)
    for pose in rig(world.cell, 2):
        raster, raycast = pair(camera, pose)
        for t_s in (0.3, 2.9):
            ours, theirs = raster.render(world.scene(t_s)), raycast.render(world.scene(t_s))
            difference = np.abs(ours.z_m - theirs.z_m)
            # The others are on an edge, which each renderer may assign to either side.
            assert (difference < 1e-4).mean() > 0.9995
            assert (ours.owner == theirs.owner).mean() > 0.9995


def test_people_agree_but_for_the_facets_of_their_meshes() -> None:
    world = World.demo(people=2, seed=1)
    camera = d435i_intrinsics(424, 240)
    raster, raycast = pair(camera, rig(world.cell, 1)[0])
    for t_s in (0.0, 4.0, 9.0):
        ours, theirs = raster.render(world.scene(t_s)), raycast.render(world.scene(t_s))
        people = (ours.owner == Owner.PERSON) & (theirs.owner == Owner.PERSON)
        assert people.sum() > 1000
        assert (np.abs(ours.z_m - theirs.z_m)[people] < 0.002).mean() > 0.97
        assert (ours.owner == theirs.owner).mean() > 0.999


def test_a_box_that_reaches_behind_the_camera_does_not_vanish() -> None:
    around = Body(
        "around", box_mesh("around", (2.0, 2.0, 4.0)), from_xyz_rpy((0.1, 0.0, 0.0), (0.2, 0.1, 0.3)), Owner.ROOM
    )
    ours, theirs = (renderer.render(scene_of(around)) for renderer in pair(SMALL, identity()))
    assert np.isfinite(theirs.z_m).all()
    np.testing.assert_allclose(ours.z_m, theirs.z_m, rtol=1e-4)


def test_fixed_bodies_are_drawn_again_after_a_change() -> None:
    near = Body("near", box_mesh("near", (1.0, 1.0, 0.1)), from_xyz_rpy((0, 0, 1.0), (0, 0, 0)), Owner.STATIC)
    far = Body("far", box_mesh("far", (9.0, 9.0, 0.1)), from_xyz_rpy((0, 0, 3.0), (0, 0, 0)), Owner.OBJECT)
    for renderer in pair(SMALL, look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))):
        both, one = Scene((near, far), (), NO_CAPSULES), Scene((far,), (), NO_CAPSULES)
        centre = (29, 47)
        first = renderer.render(both)
        assert first.z_m[centre] == pytest.approx(0.95)
        assert renderer.render(one).z_m[centre] == pytest.approx(2.95)
        assert renderer.render(both).owner[centre] == Owner.STATIC
        # The arrays belong to the caller: later frames do not change them.
        assert first.z_m[centre] == pytest.approx(0.95)
