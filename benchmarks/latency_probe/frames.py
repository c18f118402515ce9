# SPDX-License-Identifier: Apache-2.0
"""Frames of simulated cameras over one period of the robot, rendered beforehand so that nothing renders during the
measurement.

`camera_phase_s` keeps the cameras apart, because the cameras of a cell are not triggered together.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.world.robot_path import RobotPath
from simulation.world.world import World

RING_HZ = 30.0

PERIOD_S = RobotPath.demo().period_s
"""Period after which the robot repeats its motion. The people jump at that moment, which does not affect the filter."""

FRAMES = round(PERIOD_S * RING_HZ)


def camera_phase_s(camera: int, cameras: int) -> float:
    """Return the time of a camera's first frame after the beginning of each period."""
    return camera / cameras / RING_HZ


def prepare(path: Path, camera: int, cameras: int, size: tuple[int, int], frames: int = FRAMES) -> None:
    """Render the ring of one camera and write it to `path` as (frames, H, W) uint16."""
    world = World.demo(people=1)
    eye = SimulatedCamera(world, rig(world.cell, cameras)[camera], d435i_intrinsics(*size), seed=camera)
    first_s = camera_phase_s(camera, cameras)
    np.save(path, np.stack([eye.capture(first_s + number / RING_HZ).depth for number in range(frames)]))
