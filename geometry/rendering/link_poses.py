# SPDX-License-Identifier: Apache-2.0
"""Poses of the robot's links in the frame of one camera, frame by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geometry.kernels import forward
from geometry.kernels.bundles import plain
from shared.kinematics import Robot
from shared.transforms import Transform


class Links:
    """Poses of a robot's links in the camera frame, in memory allocated beforehand."""

    def __init__(self, robot: Robot, T_camera_world: Transform) -> None:
        self._robot = robot
        self._T_camera_base = T_camera_world @ robot.T_world_base
        table = robot.link_table
        self._moving = plain(
            forward.Moving(
                table.parent,
                table.dof,
                table.multiplier,
                table.offset,
                table.is_turning,
                table.axis,
                table.fixed,
                table.sine,
                table.versine,
                table.shift,
            )
        )
        self._carried = plain(forward.Carried(table.body, table.T_body_link, table.chain, table.corners))
        count = len(robot.links)
        self._poses = np.empty((count, 4, 4))
        bodies, local = np.empty((len(table.parent) + 1, 4, 4)), np.empty((4, 4))
        self._stand = plain(forward.Stand(self._poses, bodies, local))
        self._displacement_m = np.empty(count)

    def place(self, joints: ArrayLike) -> NDArray[np.float64]:
        """Return `T_camera_link` (L, 4, 4) at joint positions (n,), rad or m; valid until the next call.

        Raises:
            InputError: the count of joints is wrong, or a value is not finite.
        """
        positions = np.array(self._robot.check_joints(joints))
        forward.place_links(positions, self._T_camera_base, self._moving, self._carried, self._stand)
        return self._poses

    def displacement_m(self, uncertainty: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the largest motion (L,), metres, of any point of each link for joint errors of `uncertainty` (n,).

        The motion is from the poses of the last `place`. Valid until the next call; see `Robot.displacement_m`.
        """
        forward.displace_links(uncertainty, self._moving, self._carried, self._stand, self._displacement_m)
        return self._displacement_m
