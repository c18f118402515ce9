# SPDX-License-Identifier: Apache-2.0
"""The robot's path over the demo cell's table."""

from __future__ import annotations

import numpy as np
import pytest

from shared.errors import InputError
from shared.transforms import apply
from simulation.world.robot_path import RobotPath, ShuttlePath
from simulation.world.world import World


@pytest.fixture(scope="module")
def world() -> World:
    return World.demo(people=0)


def test_velocities_are_the_derivative_of_the_positions() -> None:
    path, step_s = RobotPath.demo(), 1e-6
    for t_s in (0.0, 1.234, 5.9, 1000.5):
        slope = (path.joints_at(t_s + step_s) - path.joints_at(t_s - step_s)) / (2.0 * step_s)
        np.testing.assert_allclose(path.velocities_at(t_s), slope, atol=1e-5)


def test_it_repeats_after_its_period() -> None:
    path = RobotPath.demo(speed=2.0)
    assert path.period_s == RobotPath.demo().period_s / 2.0
    np.testing.assert_allclose(path.joints_at(0.7), path.joints_at(0.7 + 3 * path.period_s), atol=1e-9)


def test_a_robot_at_rest_does_not_move() -> None:
    path = RobotPath.still((0.1, 0.2, 0.3))
    np.testing.assert_array_equal(path.joints_at(3.7), (0.1, 0.2, 0.3))
    np.testing.assert_array_equal(path.velocities_at(3.7), np.zeros(3))


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_that_is_not_positive_is_refused(speed: float) -> None:
    with pytest.raises(InputError, match="speed"):
        RobotPath.demo(speed)


def test_the_robot_stays_above_the_table_out_of_the_tray_and_below_a_metre_a_second(world: World) -> None:
    robot = world.cell.robot
    assert robot is not None
    (tray,) = world.cell.objects
    low, high = (tray.T_world_mesh[:3, 3] + corner for corner in tray.mesh.bounds_m)
    step_s, tips = 0.02, []
    for t_s in np.arange(0.0, RobotPath.demo().period_s, step_s):
        joints = world.joints_at(t_s)
        assert joints is not None
        poses = robot.T_world_base @ robot.link_poses(joints)
        moving = [link for link in robot.links if link.moving]
        points = np.concatenate([apply(poses[link.index], link.mesh.vertices) for link in moving])
        assert points[:, 2].min() > 0.02
        assert not ((points > low - 0.02) & (points < high + 0.02)).all(axis=1).any()
        tips.append(poses[-1] @ (0.0, 0.0, 0.12, 1.0))
    speed_m_s = np.linalg.norm(np.diff(tips, axis=0), axis=1) / step_s
    assert 0.3 < speed_m_s.mean() < 0.6
    assert 0.6 < speed_m_s.max() < 1.0


def test_a_shuttle_moves_with_a_trapezoidal_speed_profile() -> None:
    """The second joint's range is too short for full speed, the third has none."""
    path = ShuttlePath(np.array((1.0, 0.0, 0.3)), np.array((0.5, 0.02, 0.0)), np.array((2.0, 2.0, 2.0)), 15.0)
    times_s, step_s = np.arange(0.0, 5.0, 0.001), 1e-7
    joints = np.array([path.joints_at(t_s) for t_s in times_s])
    speeds = np.array([path.velocities_at(t_s) for t_s in times_s])
    np.testing.assert_allclose(joints.min(axis=0), (0.5, -0.02, 0.3), atol=1e-4)
    np.testing.assert_allclose(joints.max(axis=0), (1.5, 0.02, 0.3), atol=1e-4)
    np.testing.assert_allclose(np.abs(speeds).max(axis=0), (2.0, np.sqrt(0.04 * 15.0), 0.0), atol=0.02)
    assert np.abs(np.diff(speeds, axis=0)).max() <= 15.0 * 0.001 + 1e-9
    for t_s in (0.01, 0.3, 0.7, 1.234, 4.9):
        slope = (path.joints_at(t_s + step_s) - path.joints_at(t_s - step_s)) / (2.0 * step_s)
        np.testing.assert_allclose(path.velocities_at(t_s), slope, atol=1e-4)
