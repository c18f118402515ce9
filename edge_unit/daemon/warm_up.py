# SPDX-License-Identifier: Apache-2.0
"""The warm-up: kernels are compiled or loaded before the first frame, most before the camera's pose is known."""

from __future__ import annotations

import gc

import numpy as np

from edge_unit.pipeline import DepthPipeline
from geometry.rendering.padded_hull import make_hull
from shared.camera import Intrinsics
from shared.cell import Cell, PlacedMesh
from shared.joint_table import DHJoint
from shared.kinematics import Robot
from shared.meshes import box_mesh
from shared.transforms import from_xyz_rpy, identity

CAMERA = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
"""Kernels are compiled for types, not for sizes."""

DEPTH_MM = 1000

SPECK_HULL_M = 0.05
"""Distance of the hull that is made for the sake of its kernels; that of a small body takes a few milliseconds."""


def warm_up_kernels() -> None:
    """Run the pipeline once on a cell with a wall and a robot, whatever the true cell has."""
    wall = PlacedMesh("wall", box_mesh("wall", (2.0, 2.0, 0.1)), from_xyz_rpy((0.0, 0.0, 3.0), np.zeros(3)))
    robot = Robot.from_dh(
        [DHJoint("joint")],
        [None, box_mesh("link", (0.2, 0.2, 0.2))],
        T_world_base=from_xyz_rpy((0.0, 0.0, 2.0), np.zeros(3)),
    )
    cell = Cell("warm-up", np.full(3, -1.0), np.full(3, 2.0), static=(wall,), robot=robot)
    pipeline = DepthPipeline(CAMERA, identity(), cell)
    # The link's hull may be on the disk already, and then its kernels would be loaded with the first other robot.
    make_hull(box_mesh("speck", (0.02, 0.02, 0.02)), SPECK_HULL_M)
    for joint_rad in (0.0, 0.1):
        pipeline.process(np.full(CAMERA.shape, DEPTH_MM, np.uint16), np.array([joint_rad]), with_misfit=True)


def warm_up(pipeline: DepthPipeline) -> None:
    """Prepare all that `pipeline` needs, with an empty frame."""
    robot = pipeline.cell.robot
    joints = None if robot is None else np.zeros(robot.joint_count)
    pipeline.process(np.zeros(pipeline.intrinsics.shape, np.uint16), joints, with_misfit=True)
    # Objects made so far live on. Without this each full collection scans them, and a frame waits 0.1 s.
    gc.collect()
    gc.freeze()
