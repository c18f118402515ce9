# SPDX-License-Identifier: Apache-2.0
"""All that moves by joints before one camera: the robot's links at a frame's time, padded for the filter, or bare."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge_unit.pipeline.expected_depth import BareRobot, RobotLayer
from geometry.rendering import Links
from shared.camera import Intrinsics
from shared.errors import InputError
from shared.kinematics import Robot
from shared.settings import FilterSettings
from shared.transforms import Transform, inverse

EXACT: ArrayLike = 0.0
"""The uncertainty of exactly known joints."""


class MovingModel:
    """The robot before one camera, drawn for one frame after the other.

    Attributes:
        robot: None in a cell without one.
        band: the depths that the padded robot covers at its last joints.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        robot: Robot | None,
        T_world_camera: Transform,
        settings: FilterSettings,
        *,
        band: RobotLayer | None = None,
        bare: BareRobot | None = None,
    ) -> None:
        """`band` and `bare` of the same robot, and `band` of the same padding, are taken over if given."""
        self._intrinsics = intrinsics
        self._settings = settings
        self._bare = bare or BareRobot(intrinsics, robot)
        self.robot = robot
        self.band = band or RobotLayer(intrinsics, robot, settings.robot_padding_m)
        self.move(T_world_camera)

    def changed(self, robot: Robot | None, settings: FilterSettings, T_world_camera: Transform) -> MovingModel:
        """Return the model of another robot or other settings; unchanged parts are kept."""
        if robot is not self.robot:
            return MovingModel(self._intrinsics, robot, T_world_camera, settings)
        same_padding = settings.robot_padding_m == self._settings.robot_padding_m
        band = self.band if same_padding else None
        return MovingModel(self._intrinsics, robot, T_world_camera, settings, band=band, bare=self._bare)

    def move(self, T_world_camera: Transform) -> None:
        """Draw the robot for another pose of the camera from now on."""
        robot = self.robot
        self._links = Links(robot, inverse(T_world_camera)) if robot else None
        self._is_fixed = np.array([not link.moving for link in (robot.links if robot else ())], np.bool_)
        self.band.forget()

    def place(
        self, joints: ArrayLike | None, joint_uncertainty_rad: ArrayLike = EXACT, *, without_fixed_links: bool = False
    ) -> RobotLayer:
        """Draw the padded robot at the frame's time; returns its band of depths.

        Args:
            joints: (n,) rad (m where prismatic); None if they are not known: then the band is empty.
            joint_uncertainty_rad: uncertainty of each joint, one number or (n,); it widens the padding.
            without_fixed_links: leave out the links that never move.

        Raises:
            InputError: joints or their uncertainty have the wrong shape or values.
        """
        if self._links is None:
            return self.band
        uncertainty = self._checked(joint_uncertainty_rad)
        if joints is None:
            self.band.forget()
            return self.band
        settings = self._settings
        T_camera_link = self._links.place(joints)
        padding_m, most_m = self.band.padding_m, settings.robot_padding_m
        if uncertainty is not None:
            padding_m = (padding_m + self._links.displacement_m(uncertainty)).astype(np.float32)
            most_m = float(padding_m.max(initial=0.0))
        self.band.draw(
            T_camera_link,
            padding_m,
            settings.margin_noise_gain * self._intrinsics.disparity_noise_m(settings.stereo_subpixel_px),
            # The padded surface lies before the true one by the padding.
            settings.robot_depth_m + most_m,
            self._is_fixed if without_fixed_links else None,
        )
        return self.band

    def lower(self, joints: ArrayLike | None, joint_uncertainty_rad: ArrayLike, depth_m: NDArray[np.float32]) -> None:
        """Lower `depth_m` (H, W) to the unpadded robot where it is nearer; arguments and errors as in `place`."""
        if self._links is not None and joints is not None:
            self._checked(joint_uncertainty_rad)
            self._bare.lower(self._links.place(joints), depth_m)

    def _checked(self, joint_uncertainty_rad: ArrayLike) -> NDArray[np.float64] | None:
        """Return the uncertainty (n,) of each joint; None if there is none."""
        if joint_uncertainty_rad is EXACT:
            return None
        count = self.robot.joint_count if self.robot else 0
        try:
            uncertainty = np.asarray(joint_uncertainty_rad, np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"joint_uncertainty_rad: expected numbers, got {joint_uncertainty_rad!r}") from error
        sound = (uncertainty >= 0.0) & np.isfinite(uncertainty)
        if uncertainty.shape not in ((), (count,)) or not sound.all():
            raise InputError(
                f"joint_uncertainty_rad: expected one finite number of at least 0, or {count}, "
                f"got {uncertainty.tolist()}"
            )
        return np.array(np.broadcast_to(uncertainty, (count,))) if uncertainty.any() else None
