# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.pipeline import DepthPipeline, Refiner
from edge_unit.pipeline.pose_refinement import FAR_M, median_depth_m, planes_of
from geometry.kernels import align
from geometry.kernels.bundles import plain
from geometry.rendering.kernel_camera import camera_of
from shared.errors import InputError
from shared.transforms import Transform, from_xyz_rpy, inverse
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.world.world import World
from tests.edge_unit.scenes import OVERHEAD, Depth, bodies, camera, demo_cell, measured, raycast, small_cell

EYE = camera(212, 120)
FOCAL, CENTRE = (EYE.fx, EYE.fy), (EYE.cx, EYE.cy)
LENS = camera_of(EYE)
NUDGE = from_xyz_rpy((0.01, -0.02, 0.015), (0.01, -0.02, 0.015))


def error_of(found: Transform, true: Transform) -> tuple[float, float]:
    """In mm and degrees."""
    X = inverse(true) @ found
    return 1000.0 * float(np.linalg.norm(X[:3, 3])), float(
        np.degrees(np.arccos(np.clip(0.5 * (np.trace(X[:3, :3]) - 1.0), -1.0, 1.0)))
    )


def expected_of_small_cell() -> NDArray[np.float32]:
    return raycast(bodies(small_cell(robot=False), None), OVERHEAD, EYE).astype(np.float32)


def slow(
    points: NDArray[np.float32], expected: NDArray[np.float32], T: Transform, scale: NDArray[np.float32]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    oblique, normals = planes_of(expected, EYE)
    total, distances = 0.0, np.full(points.shape[1], np.nan)
    information, gradient = np.zeros((6, 6)), np.zeros(6)
    for i, point in enumerate(points.T.astype(float)):
        p = T[:3, :3] @ point + T[:3, 3]
        cost = align.UNKNOWN_COST
        if p[2] > 0:
            u, v = (int(np.floor(p[k] / p[2] * FOCAL[k] + CENTRE[k] + 0.5)) for k in (0, 1))
            if 0 <= u < EYE.width and 0 <= v < EYE.height and np.isfinite(expected[v, u]):
                distances[i] = (p[2] - expected[v, u]) * oblique[v, u]
                r = distances[i] / scale[i]
                cost = r * r / (1 + r * r)
                n = normals[v, u].astype(float)
                if np.isfinite(n[0]):
                    q = np.array(((u - CENTRE[0]) / FOCAL[0], (v - CENTRE[1]) / FOCAL[1], 1.0)) * expected[v, u]
                    d = n @ (p - q)
                    weight = 1.0 / (1.0 + (d / scale[i]) ** 2) ** 2 / scale[i] ** 2
                    jacobian = np.concatenate((np.cross(p, n), n))
                    gradient += weight * d * jacobian
                    information += weight * np.outer(jacobian, jacobian)
        total += cost
    return total, distances, information, gradient


@pytest.mark.parametrize("kind", ["random", "none", "behind", "unknown"])
def test_the_kernels_equal_their_slow_twins(kind: str) -> None:
    rng = np.random.default_rng(2)
    expected = expected_of_small_cell()
    points = rng.uniform((-1.2, -0.8, 0.2), (1.2, 0.8, 3.0), (500, 3)).T.astype(np.float32)
    if kind == "none":
        points = points[:, :0]
    elif kind == "behind":
        points[2] *= -1
    elif kind == "unknown":
        expected = np.full(EYE.shape, np.inf, np.float32)
    points, scale = np.ascontiguousarray(points), np.full(points.shape[1], 0.05, np.float32)
    oblique, normals = planes_of(expected, EYE)
    distances = np.empty(points.shape[1], np.float32)
    seen, measured_points = plain(align.Planes(expected, oblique, normals)), plain(align.Measured(points, scale))
    cost = align.plane_cost(measured_points, seen, LENS, NUDGE, distances)
    information, gradient = np.empty((6, 6)), np.empty(6)
    align.normal_equations(measured_points, seen, LENS, NUDGE, information, gradient)
    slow_cost, slow_distances, slow_information, slow_gradient = slow(points, expected, NUDGE, scale)
    # A point on the border of two pixels may fall to either side in float32.
    assert cost == pytest.approx(slow_cost, abs=2.0)
    same = np.isclose(distances, slow_distances, atol=1e-4, equal_nan=True)
    assert not same.size or same.mean() >= 0.99
    np.testing.assert_allclose(information, slow_information, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(gradient, slow_gradient, rtol=1e-3, atol=1e-3)


def test_planes_have_the_normals_that_they_are_drawn_with_and_edges_have_none() -> None:
    expected = expected_of_small_cell()
    oblique, normals = planes_of(expected, EYE)
    up = OVERHEAD[:3, :3].T @ (0.0, 0.0, 1.0)
    on_planes = np.isfinite(normals[..., 0]) & np.isfinite(expected)
    aligned = np.abs(normals[on_planes] @ up)
    assert (aligned > 0.999).mean() > 0.8, "floor and the crate's top"
    assert np.isnan(normals[~np.isfinite(expected)]).all()
    v, u = np.mgrid[0 : EYE.height, 0 : EYE.width]
    rays = np.stack(((u - CENTRE[0]) / FOCAL[0], (v - CENTRE[1]) / FOCAL[1], np.ones(u.shape)), -1)
    np.testing.assert_allclose(oblique[on_planes], np.sum(normals * rays, -1)[on_planes], rtol=1e-4)


def frames_of(number: int, pipeline: DepthPipeline, count: int = 20) -> list[Depth]:
    """Return frames of a camera of the demo rig, with people in view."""
    true = rig(demo_cell(), 4)[number]
    eye = SimulatedCamera(World.demo(people=2, seed=3, cell=demo_cell()), true, pipeline.intrinsics, seed=number)
    frames = [eye.capture(0.1 * n) for n in range(count)]
    return [pipeline.without_robot(frame.depth, frame.joints) for frame in frames]


@pytest.mark.parametrize("number", [1, 3])
def test_a_pose_that_is_off_comes_nearer_to_the_truth(number: int) -> None:
    intrinsics = d435i_intrinsics(848, 480)
    true = rig(demo_cell(), 4)[number]
    wrong = true @ from_xyz_rpy((0.012, -0.01, 0.012), np.radians((0.8, -0.9, 0.9)))
    pipeline = DepthPipeline(intrinsics, wrong, demo_cell())
    found = pipeline.refiner().refine(frames_of(number, pipeline))
    assert found.accepted, found.reason
    off_mm, off_deg = error_of(found.T_world_camera, true)
    assert off_mm < 12.0
    assert off_deg < 0.3
    assert found.after_mm < 0.5 * found.before_mm
    assert error_of(wrong, true) == pytest.approx((19.7, 1.5), abs=0.2)


def test_a_right_pose_stays_unchanged() -> None:
    true = rig(demo_cell(), 4)[3]
    pipeline = DepthPipeline(d435i_intrinsics(424, 240), true, demo_cell())
    found = pipeline.refiner().refine(frames_of(3, pipeline))
    off_mm, off_deg = error_of(found.T_world_camera, true)
    assert off_mm < 5.0
    assert off_deg < 0.25


def test_a_far_pose_is_never_accepted() -> None:
    cell = small_cell(robot=False)
    eye = camera(424, 240)
    depth = measured(raycast(bodies(cell, None), OVERHEAD, eye), eye)
    for off in (from_xyz_rpy((0, 0, -0.3), (0, 0, 0)), from_xyz_rpy((0, 0, 0), (np.radians(12.0), 0, 0))):
        pipeline = DepthPipeline(eye, OVERHEAD @ off, cell)
        found = pipeline.refiner().refine([depth])
        if found.accepted:
            assert found.moved_mm <= 1000.0 * FAR_M
            assert found.after_mm < found.before_mm
        else:
            assert found.reason
            assert np.array_equal(found.T_world_camera, pipeline.T_world_camera)


def test_without_known_surfaces_in_view_it_is_refused() -> None:
    eye = camera(424, 240)
    pipeline = DepthPipeline(eye, OVERHEAD, small_cell(robot=False, floor=False))
    found = pipeline.refiner().refine([np.full(eye.shape, 1500, np.uint16)])
    assert not found.accepted
    assert "nothing to align with" in found.reason


def test_an_image_of_another_shape_or_type_is_refused() -> None:
    pipeline = DepthPipeline(EYE, OVERHEAD, small_cell(robot=False))
    with pytest.raises(InputError, match="at least one frame"):
        pipeline.refiner().refine([])
    with pytest.raises(InputError):
        pipeline.refiner().refine([np.zeros((3, 4), np.uint16)])
    metres: Any = np.zeros(EYE.shape, np.float32)
    with pytest.raises(InputError):
        Refiner(EYE, OVERHEAD, expected_of_small_cell(), 0.01).refine([metres])


def test_the_median_needs_half_of_the_frames() -> None:
    frames = [
        np.array([[1000, 0, 5]], np.uint16),
        np.array([[1200, 0, 0]], np.uint16),
        np.array([[1100, 0, 0]], np.uint16),
    ]
    median = median_depth_m(frames, 0.001)
    assert median[0, 0] == np.float32(1.1)
    assert np.isnan(median[0, 1:]).all()
