# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.pipeline import DepthPipeline, Misfit
from edge_unit.pipeline.pose_misfit import STEPS, MisfitCheck
from geometry.kernels import misfit
from geometry.kernels.agreement import Tolerance
from geometry.kernels.bundles import plain
from geometry.rendering.kernel_camera import camera_of
from shared.settings import FilterSettings
from shared.transforms import Transform, from_xyz_rpy
from tests.edge_unit.scenes import OVERHEAD, Depth, bodies, camera, measured, raycast, small_cell

CAMERA = camera(212, 120)
NO_ROBOT = np.full(CAMERA.shape, 65535, np.uint16)
FOCAL, CENTRE = (CAMERA.fx, CAMERA.fy), (CAMERA.cx, CAMERA.cy)
LENS = camera_of(CAMERA)
BASE, PER = 10.0, 2e-6
SCALE, MARGIN = plain(Tolerance(BASE, PER)), plain(Tolerance(30.0, 1e-5))


def points_of(
    depth: Depth, static: Depth, robot: Depth = NO_ROBOT, stride: int = 3
) -> tuple[NDArray[np.float32], list[int]]:
    points = np.full((3, depth.size), np.nan, np.float32)
    tallies = np.zeros(4, np.int64)
    found = misfit.compared_points(depth, static, robot, LENS, MARGIN, stride, points, tallies)
    return points[:, :found], tallies.tolist()


def slow_points(depth: Depth, static: Depth, robot: Depth, stride: int) -> tuple[NDArray[np.float64], list[int]]:
    rows, columns = (np.arange(stride // 2, size, stride) for size in depth.shape)
    v, u = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    z, expected, bare = depth[v, u].astype(float), static[v, u].astype(float), robot[v, u] == 65535
    used = (z > 0) & bare
    beyond = used & (expected > 0) & (z - expected > 30.0 + 1e-5 * expected**2)
    points = np.stack(((u - CENTRE[0]) / FOCAL[0] * z, (v - CENTRE[1]) / FOCAL[1] * z, z))[:, used]
    return points, [len(v), int((expected > 0).sum()), int((z > 0).sum()), int(beyond.sum())]


def slow_misfit(points: NDArray[np.float64], static: Depth, T: Transform) -> float:
    there = T[:3, :3] @ points + T[:3, 3:]
    total = 0.0
    for (x, y, z), measured_z in zip(there.T, points[2], strict=True):
        value = misfit.UNKNOWN_MISFIT
        if z > 0:
            u, v = int(np.floor(x / z * FOCAL[0] + CENTRE[0] + 0.5)), int(np.floor(y / z * FOCAL[1] + CENTRE[1] + 0.5))
            if 0 <= u < static.shape[1] and 0 <= v < static.shape[0] and static[v, u]:
                r = (z - static[v, u]) / (BASE + PER * measured_z**2)
                value = r * r / (1 + r * r)
        total += value
    return total


def images(kind: str) -> tuple[Depth, Depth, Depth]:
    rng = np.random.default_rng(3)
    if kind == "empty":
        return np.zeros(CAMERA.shape, np.uint16), np.zeros(CAMERA.shape, np.uint16), NO_ROBOT
    if kind == "farthest":
        full = np.full(CAMERA.shape, 65535, np.uint16)
        return full, full, NO_ROBOT
    depth, static = rng.integers(0, 4000, (2, *CAMERA.shape)).astype(np.uint16)
    depth[rng.random(CAMERA.shape) < 0.2] = 0
    static[rng.random(CAMERA.shape) < 0.3] = 0
    robot = np.where(rng.random(CAMERA.shape) < 0.2, 1000, 65535).astype(np.uint16)
    return depth, static, robot


@pytest.mark.parametrize("kind", ["random", "empty", "farthest"])
@pytest.mark.parametrize("stride", [1, 3, 7])
def test_the_kernels_equal_their_slow_twins(kind: str, stride: int) -> None:
    depth, static, robot = images(kind)
    points, tallies = points_of(depth, static, robot, stride)
    slow, slow_tallies = slow_points(depth, static, robot, stride)
    assert tallies == slow_tallies
    np.testing.assert_allclose(points, slow, rtol=1e-6, atol=1e-3)
    for T in (np.eye(4), from_xyz_rpy((20.0, -35.0, 15.0), (0.01, -0.02, 0.03)), from_xyz_rpy((0, 0, 0), (0, 3.0, 0))):
        fast = misfit.misfit_there(points, points.shape[1], static, LENS, T, SCALE)
        # A point that falls upon the border of two pixels may fall to either side in float32.
        assert fast == pytest.approx(slow_misfit(slow, static, T), abs=2e-3 * max(points.shape[1], 1) + 1e-6)


def seen_from(X: Transform) -> Misfit:
    """Return the misfit of the small cell, seen from `X` beside the camera's expected pose."""
    cell = small_cell(robot=False)
    eye = camera(424, 240)
    pipeline = DepthPipeline(eye, OVERHEAD, cell)
    depth = measured(raycast(bodies(cell, None), OVERHEAD @ X, eye), eye)
    misfit = pipeline.process(depth, None, with_misfit=True).misfit
    assert misfit is not None
    return misfit


def test_the_slope_points_to_the_true_pose() -> None:
    straight = seen_from(np.eye(4))
    assert (straight.curvature[:3] > 0.0).all()
    assert straight.beyond_share < 1e-3
    for axis in (0, 1, 5):
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            step[axis] = sign * 0.5 * STEPS[axis]
            there = seen_from(from_xyz_rpy(step[3:], step[:3]))
            assert np.sign(there.slope[axis] - straight.slope[axis]) == -sign


def test_depth_before_the_known_surfaces_does_not_count_and_depth_behind_does() -> None:
    check = MisfitCheck(CAMERA)
    wall = np.full(CAMERA.shape, 2000, np.uint16)
    box = wall.copy()
    box[20:60, 40:100] = 1200
    assert check.check(box, wall, NO_ROBOT, FilterSettings()).beyond_share == 0.0
    hole = wall.copy()
    hole[20:60, 40:100] = 3000
    share = 40 * 60 / hole.size
    assert check.check(hole, wall, NO_ROBOT, FilterSettings()).beyond_share == pytest.approx(share, rel=0.2)
