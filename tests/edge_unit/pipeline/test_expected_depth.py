# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from edge_unit.pipeline import BareRobot, DepthPipeline
from edge_unit.pipeline.expected_depth import RobotLayer, StaticLayer
from geometry.kernels.limits import RAW_MAX
from geometry.rendering import DepthBuffer, MeshBatch, hull_around
from geometry.rendering.mesh_renderer import KEPT_AFTER, STILL_M
from shared.cell import Cell, PlacedMesh
from shared.kinematics import Robot
from shared.meshes import box_mesh, sphere_mesh
from shared.transforms import Transform, from_xyz_rpy, inverse, look_at
from tests.edge_unit.scenes import (
    ABOVE_TABLE,
    HOME_RAD,
    OVERHEAD,
    bodies,
    camera,
    demo_cell,
    grown,
    placed,
    raycast,
    small_robot,
)

PADDING_M = 0.05
NOISE_PER_M, DEPTH_M = 0.02, 0.15

# ---------------------------------------------------------------- against an independent ray caster

VIEWS: list[tuple[Transform, ArrayLike]] = [
    (ABOVE_TABLE, HOME_RAD),
    (look_at((-0.9, -1.1, 1.4), (0.2, 0.0, 0.2)), (1.2, -0.6, 0.9, -2.0, 1.2, 2.0)),
    (look_at((0.35, 0.0, 1.2), (0.3, 0.05, 0.0)), (-0.8, -2.0, -1.2, 0.4, 0.9, -1.0)),
    (look_at((0.45, -0.45, 0.35), (0.1, 0.0, 0.25)), np.zeros(6)),
]


@pytest.mark.parametrize("view", range(len(VIEWS)))
def test_expected_depth_agrees_with_ray_casting(view: int) -> None:
    """UR3e, gripper, table, shelf, tray and floor at 1280 x 720."""
    T_world_camera, joints = VIEWS[view]
    intrinsics, cell = camera(1280, 720), demo_cell()
    expected_m = DepthPipeline(intrinsics, T_world_camera, cell).expected_depth(joints)
    cast_m = raycast(bodies(cell, joints), T_world_camera, intrinsics)
    assert expected_m.dtype == np.float32
    drawn, hit = np.isfinite(expected_m), np.isfinite(cast_m)
    both = drawn & hit
    assert both.mean() > 0.3
    agree = np.abs(expected_m[both] - cast_m[both]) <= 0.001
    print(f"view {view}: {100 * agree.mean():.4f} % within 1 mm, {(drawn ^ hit).sum()} pixels hit by one only")
    assert agree.mean() >= 0.999
    assert not (drawn & ~grown(hit)).any()
    assert not (hit & ~grown(drawn)).any()


@pytest.mark.parametrize("view", range(len(VIEWS)))
def test_the_robots_silhouette_is_that_of_rays(view: int) -> None:
    T_world_camera, joints = VIEWS[view]
    intrinsics, robot = camera(1280, 720), demo_cell().robot
    cell = Cell("robot alone", np.full(3, -1.0), np.full(3, 1.0), robot=robot)
    expected_m = DepthPipeline(intrinsics, T_world_camera, cell).expected_depth(joints)
    cast_m = raycast(bodies(cell, joints), T_world_camera, intrinsics)
    drawn, hit = np.isfinite(expected_m), np.isfinite(cast_m)
    assert hit.sum() > 5000
    both = drawn & hit
    agree = np.abs(expected_m[both] - cast_m[both]) <= 0.001
    print(f"view {view}: {100 * agree.mean():.4f} % within 1 mm, {(drawn ^ hit).sum()} of {hit.sum()} by one only")
    assert agree.mean() >= 0.999
    assert (drawn ^ hit).sum() <= 0.001 * hit.sum() + 5
    assert not (drawn & ~grown(hit)).any()
    assert not (hit & ~grown(drawn)).any()


def test_a_link_that_the_near_plane_cuts_does_not_vanish() -> None:
    """The arm passes right before the lens: one end lies behind the camera, the other fills the image's middle."""
    intrinsics = camera(424, 240)
    bar = box_mesh("bar", (1.0, 0.05, 0.05))
    T_world_camera = look_at((0.0, 0.09, 0.0), (0.4, -0.05, 0.0))
    cell = Cell("bar", np.full(3, -1.0), np.full(3, 1.0), static=(placed("bar", bar),))
    expected_m = DepthPipeline(intrinsics, T_world_camera, cell).expected_depth(None)
    cast_m = raycast(cell.static, T_world_camera, intrinsics)
    beyond = np.isfinite(cast_m) & (cast_m > 0.06)
    assert beyond.mean() > 0.1
    assert (np.abs(expected_m[beyond] - cast_m[beyond]) <= 0.001).mean() >= 0.999


# ---------------------------------------------------------------- meshes as flat arrays


def test_a_batch_without_meshes_draws_nothing() -> None:
    intrinsics = camera(64, 40)
    batch, buffer = MeshBatch(intrinsics, [], inflate=True), DepthBuffer(intrinsics)
    batch.draw(np.zeros((0, 4, 4)), np.zeros(0, np.float32), buffer)
    assert not buffer.window.any()
    assert not buffer.nearest_w.any()


def test_meshes_of_a_batch_keep_to_themselves() -> None:
    """The meshes one by one give the same image as all together."""
    intrinsics = camera(160, 90)
    meshes = [sphere_mesh("ball", 0.2), box_mesh("box", (0.2, 0.3, 0.1)), sphere_mesh("small", 0.05)]
    poses = [from_xyz_rpy((x, 0.1 * x, 1.5 + x), (x, 0.2, 0.0)) for x in (-0.5, 0.1, 0.4)]
    bodies = [PlacedMesh(mesh.name, mesh, pose) for mesh, pose in zip(meshes, poses, strict=True)]
    together = StaticLayer(intrinsics, bodies)
    together.draw(np.eye(4))
    alone = np.zeros(intrinsics.shape, np.float32)
    for body in bodies:
        layer = StaticLayer(intrinsics, [body])
        layer.draw(np.eye(4))
        alone = np.maximum(alone, layer.nearest_w)
    assert (together.nearest_w == alone).all()


def test_the_static_layer_is_drawn_anew_each_time() -> None:
    mesh = sphere_mesh("ball", 0.2)
    near, far = placed("ball", mesh, (0, 0, 1)), placed("ball", mesh, (0.3, 0, 2))
    layer = StaticLayer(camera(160, 90), [near])
    layer.draw(np.eye(4))
    first = layer.nearest_w.copy()
    moved = layer.of([far])
    moved.draw(np.eye(4))
    assert (moved.nearest_w != first).any()
    again = moved.of([near])
    again.draw(np.eye(4))
    assert (again.nearest_w == first).all()
    again.draw(look_at((0, 0, 0), (0, 0, -1)))
    assert not again.nearest_w.any()


def test_bodies_that_did_not_move_are_not_drawn_again() -> None:
    ball, other = sphere_mesh("ball", 0.2), box_mesh("other", (0.2, 0.2, 0.2))
    layer = StaticLayer(camera(160, 90), [placed("ball", ball, (0, 0, 1))])
    layer.draw(np.eye(4))
    assert layer.of([placed("ball", ball, (0, 0, 1))]) is layer
    picture = layer.nearest_w
    layer.draw(np.eye(4))
    assert layer.nearest_w is picture
    swapped = layer.of([placed("other", other, (0, 0, 1))])
    swapped.draw(np.eye(4))
    assert (swapped.nearest_w != picture).any()
    assert not layer.of([]).nearest_w.any()


def test_the_bare_robot_keeps_no_old_pose() -> None:
    robot, intrinsics = small_robot(), camera(160, 90)
    layer = BareRobot(intrinsics, robot)

    def draw(angle_rad: float) -> NDArray[np.float32]:
        depth_m = np.full(intrinsics.shape, np.inf, np.float32)
        layer.lower(inverse(OVERHEAD) @ robot.link_poses([angle_rad]), depth_m)
        return depth_m

    first, second = draw(0.0), draw(1.5)
    assert (second != first).any()
    # From the fourth drawing on the column is kept; both of its drawings are the same.
    for _ in range(3 * KEPT_AFTER):
        assert (draw(0.0) == first).all()
        assert (draw(1.5) == second).all()


# ---------------------------------------------------------------- the padded robot


class Arm:
    """The small robot before its camera."""

    def __init__(self, robot: Robot | None = None) -> None:
        self.intrinsics = camera(424, 240)
        self.robot = robot or small_robot()
        self.layer = RobotLayer(self.intrinsics, self.robot, PADDING_M)

    def poses(self, *joints: float) -> NDArray[np.float64]:
        return inverse(OVERHEAD) @ self.robot.T_world_base @ self.robot.link_poses(joints)

    def draw(self, angle_rad: float, padding_m: ArrayLike = PADDING_M, hidden: list[bool] | None = None) -> bool:
        padding = np.broadcast_to(np.asarray(padding_m, np.float32), (len(self.robot.links),))
        mask = None if hidden is None else np.array(hidden)
        return self.layer.draw(self.poses(angle_rad), np.ascontiguousarray(padding), NOISE_PER_M, DEPTH_M, mask)

    @property
    def there(self) -> NDArray[np.bool_]:
        return np.asarray(self.layer.near_raw < RAW_MAX)

    def bare_m(self, angle_rad: float) -> NDArray[np.float64]:
        cell = Cell("arm", np.full(3, -1.0), np.full(3, 1.0), robot=self.robot)
        return raycast(bodies(cell, [angle_rad]), OVERHEAD, self.intrinsics)


def test_the_band_is_that_of_rays_on_the_inflated_hulls() -> None:
    arm = Arm()
    assert arm.draw(0.4)
    poses = arm.robot.link_poses([0.4])
    hulls = [
        PlacedMesh(link.name, hull_around(link.mesh, PADDING_M), pose)
        for link, pose in zip(arm.robot.links, poses, strict=True)
    ]
    near_m = raycast(hulls, OVERHEAD, arm.intrinsics)
    hit = np.isfinite(near_m)
    near_m, back_m = near_m[hit], raycast(hulls, OVERHEAD, arm.intrinsics, farthest=True)[hit]
    far_m = np.maximum(back_m, near_m + DEPTH_M)
    assert 0.05 < (back_m > near_m + DEPTH_M).mean() < 0.95, "both ends are tried"
    assert (arm.there == hit).mean() > 0.9999
    low_m = arm.layer.near_raw[hit] / 1000
    high_m = low_m + arm.layer.span_raw[hit] / 1000
    assert (np.abs(low_m - (near_m - NOISE_PER_M * near_m**2)) <= 0.002).mean() > 0.995
    assert (np.abs(high_m - (far_m + NOISE_PER_M * far_m**2)) <= 0.003).mean() > 0.99


def test_from_within_the_padding_all_is_robot_up_to_the_links_back() -> None:
    """The arm points away from the camera, and starts 30 mm before it."""
    arm = Arm()
    poses = np.stack((np.eye(4), from_xyz_rpy((0.0, 0.0, 0.03), (0.0, -np.pi / 2, 0.0))))
    padding_m = np.full(2, PADDING_M, np.float32)
    assert arm.layer.draw(poses, padding_m, NOISE_PER_M, DEPTH_M, np.array([True, False]))
    middle = (120, 212)
    assert arm.layer.near_raw[middle] == 0
    assert arm.layer.span_raw[middle] == pytest.approx(1000.0 * (0.43 + PADDING_M + NOISE_PER_M * 0.48**2), abs=5.0)


def test_from_outside_the_padding_no_pixel_has_a_back_without_a_front() -> None:
    """At silhouettes triangles that face the camera and triangles that face away cover the same pixels."""
    arm = Arm()
    for angle in np.linspace(0.0, 2.0 * np.pi, 100):
        assert arm.draw(float(angle))
        assert (arm.layer.near_raw > 500).all()


def test_the_padding_surrounds_the_robot() -> None:
    """50 mm at some 1.4 m are 7 px here."""
    arm = Arm()
    arm.draw(0.4)
    hit = np.isfinite(arm.bare_m(0.4))
    assert arm.there[grown(hit, 4)].all()
    assert not (arm.there & ~grown(hit, 20)).any()


def test_columns_enclose_the_robot() -> None:
    arm = Arm()
    arm.draw(0.4)
    u = np.arange(arm.there.shape[1])
    within = (u >= arm.layer.columns[:, :1]) & (u < arm.layer.columns[:, 1:])
    assert not (arm.there & ~within).any()
    assert within.sum() < 4 * arm.there.sum()


def test_the_same_joints_are_not_drawn_again() -> None:
    arm = Arm()
    assert arm.draw(0.4)
    near_raw = arm.layer.near_raw.copy()
    assert not arm.draw(0.4)
    assert (arm.layer.near_raw == near_raw).all()
    assert arm.draw(0.5)
    assert (arm.layer.near_raw != near_raw).any()


def test_after_any_way_the_band_is_that_of_a_fresh_layer() -> None:
    arm = Arm()
    rng = np.random.default_rng(0)
    for _ in range(20):
        arm.draw(rng.uniform(-3, 3), rng.choice([0.02, 0.05, 0.1]), [bool(rng.random() < 0.3), False])
    arm.layer.forget()
    assert not arm.there.any()
    assert not arm.layer.span_raw.any()
    arm.draw(0.4)
    fresh = Arm()
    fresh.draw(0.4)
    assert (arm.layer.near_raw == fresh.layer.near_raw).all()
    assert (arm.layer.span_raw == fresh.layer.span_raw).all()
    assert (arm.layer.columns == fresh.layer.columns).all()


def test_links_that_did_not_move_are_kept_and_the_image_equals_a_new_one() -> None:
    """An arm that turns, rests, trembles and moves again; one of its links is lost and found again."""
    arm = Arm()
    rng = np.random.default_rng(1)
    angle = 0.0
    for n in range(60):
        angle += rng.choice([0.0, 0.3]) if n % 20 < 12 else 0.0
        hidden = [n % 15 == 14, 30 <= n < 36]
        padding_m = PADDING_M + 0.01 * (n % 7 == 6)
        arm.draw(angle, [PADDING_M, padding_m], hidden)
        fresh = Arm(arm.robot)
        fresh.draw(angle, [PADDING_M, padding_m], hidden)
        assert (arm.layer.near_raw == fresh.layer.near_raw).all(), n
        assert (arm.layer.span_raw == fresh.layer.span_raw).all(), n


def test_trembling_joints_are_not_drawn_again() -> None:
    arm = Arm()
    rng = np.random.default_rng(0)
    arm.draw(0.4)
    assert not any(arm.draw(0.4 + angle) for angle in rng.uniform(-2e-4, 2e-4, 100))


def test_a_slow_drift_never_moves_far_from_the_drawn_pose() -> None:
    """Steps of a twentieth of STILL_M at the tip: each is small, and all together are not."""
    arm, tip_m = Arm(), 0.4
    arm.draw(0.0)
    drawn_rad, draws = 0.0, 0
    for angle in np.arange(1, 400) * (STILL_M / 20 / tip_m):
        if arm.draw(float(angle)):
            drawn_rad, draws = float(angle), draws + 1
        assert abs(angle - drawn_rad) * tip_m <= STILL_M
    assert draws >= 399 // 20
    fresh = Arm()
    fresh.draw(drawn_rad)
    assert (arm.layer.near_raw == fresh.layer.near_raw).all()


def test_a_drift_of_the_padding_is_followed_too() -> None:
    arm = Arm()
    arm.draw(0.0, 0.05)
    assert not arm.draw(0.0, 0.0502)
    assert arm.draw(0.0, 0.06)
    assert arm.draw(0.0, [0.06, 0.08])


def test_hidden_links_are_left_out() -> None:
    arm = Arm()
    arm.draw(0.4)
    whole = arm.there.copy()
    assert arm.draw(0.4, hidden=[True, False])
    moving = arm.there.copy()
    assert arm.draw(0.4, hidden=[False, True])
    fixed = arm.there.copy()
    assert ((moving | fixed) == whole).all()
    assert (moving & ~fixed).sum() > 100
    assert (fixed & ~moving).sum() > 100
    assert arm.draw(0.4, hidden=[True, True])
    assert not arm.there.any()
    assert arm.draw(0.4, hidden=[False, False])
    assert (arm.there == whole).all()


def test_without_a_robot_nothing_is_drawn() -> None:
    layer = RobotLayer(camera(64, 40), None, PADDING_M)
    assert (layer.near_raw == RAW_MAX).all()
    layer.forget()
    assert not layer.span_raw.any()
