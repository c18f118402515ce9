# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from geometry.rendering import Links
from shared.errors import InputError
from shared.joint_table import BASE, Attachment, Motion
from shared.kinematics import Robot
from shared.meshes import box_mesh
from shared.transforms import from_xyz_rpy, identity, inverse
from tests.edge_unit.scenes import ABOVE_TABLE, demo_cell, small_robot


def mixed(rng: np.random.Generator) -> Robot:
    """Return a robot with two branches, revolute, prismatic and mimic joints, and links on the base and on joints."""
    parents, dofs = (BASE, 0, 1, 1, BASE), (1, 0, 2, 2, 3)
    axes = rng.normal(0.0, 1.0, (5, 3))
    motions = [
        Motion(
            ("revolute", "prismatic")[k % 2],
            parents[k],
            from_xyz_rpy(rng.normal(0.0, 0.3, 3), rng.uniform(-3, 3, 3)),
            tuple(axes[k] / np.linalg.norm(axes[k])),
            dofs[k],
            (1.0, -0.5)[k == 3],
            0.1 * k,
        )
        for k in range(5)
    ]
    attachments = [
        Attachment(f"link{n}", body, from_xyz_rpy(rng.normal(0.0, 0.2, 3), rng.uniform(-3, 3, 3)), mesh)
        for n, (body, mesh) in enumerate((body, box_mesh("box", (0.2, 0.1, 0.4))) for body in (BASE, 0, 2, 3, 4, 4))
    ]
    base = from_xyz_rpy((0.3, -0.2, 0.1), (0.1, 0.2, 0.3))
    return Robot("mixed", ["a", "b", "c", "d"], motions, attachments, base)


@pytest.mark.parametrize("seed", range(5))
def test_poses_equal_those_of_the_robot(seed: int) -> None:
    rng = np.random.default_rng(seed)
    demo = demo_cell().robot
    assert demo is not None
    T_camera_world = inverse(ABOVE_TABLE)
    for robot in (demo, small_robot(), mixed(rng)):
        links = Links(robot, T_camera_world)
        for _ in range(3):
            joints = rng.uniform(-3, 3, robot.joint_count)
            placed = links.place(joints)
            np.testing.assert_allclose(
                placed, T_camera_world @ robot.T_world_base @ robot.link_poses(joints), atol=1e-12
            )
            for uncertainty in (rng.uniform(0.0, 0.2, robot.joint_count), np.full(robot.joint_count, 7.0)):
                np.testing.assert_allclose(
                    links.displacement_m(uncertainty), robot.displacement_m(uncertainty, joints), atol=1e-12
                )


def test_a_robot_that_never_moves() -> None:
    stone = Robot("stone", [], [], [Attachment("stone", BASE, identity(), box_mesh("stone", (1, 1, 1)))])
    links = Links(stone, identity())
    assert (links.place([]) == np.eye(4)).all()
    assert links.displacement_m(np.zeros(0)).tolist() == [0.0]


def test_wrong_joints_are_refused() -> None:
    links = Links(small_robot(), identity())
    with pytest.raises(InputError, match="joints: expected"):
        links.place([0.1, 0.2])
