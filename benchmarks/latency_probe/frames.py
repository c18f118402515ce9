# SPDX-License-Identifier: Apache-2.0
"""What simulated cameras see over one period of the robot, rendered beforehand: nobody renders while it is measured.

`camera_phase_s` keeps the cameras apart, as nobody triggers those of a cell together.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.world.robot_path import RobotPath
from simulation.world.world import World

RING_HZ = 30.0

PERIOD_S = RobotPath.demo().period_s
"""After which the robot is where it was; people then jump, for which a filter does not care."""

FRAMES = round(PERIOD_S * RING_HZ)


def camera_phase_s(camera: int, cameras: int) -> float:
    """When, after the beginning of each period, a camera takes its first frame."""
    return camera / cameras / RING_HZ


def prepare(path: Path, camera: int, cameras: int, size: tuple[int, int], frames: int = FRAMES) -> None:
    """Render the ring of one camera, and leave it at `path` as (frames, H, W) uint16."""
    world = World.demo(people=1)
    eye = SimulatedCamera(world, rig(world.cell, cameras)[camera], d435i_intrinsics(*size), seed=camera)
    first_s = camera_phase_s(camera, cameras)
    np.save(path, np.stack([eye.capture(first_s + number / RING_HZ).depth for number in range(frames)]))
