# SPDX-License-Identifier: Apache-2.0
"""The method: from a depth frame, the joints and all known surfaces to voxels of unknown obstacles.

In the order of the flow:

    stage_times       time that a frame spends in each stage
    expected_depth    expected depth: static layer and robot layer (Algorithms 2 to 5)
    edge_halo         false depths that a camera measures beside edges of the CAD
    background_model  the static layer that is learned from the empty cell
    static_model      all static surfaces: CAD, known objects, background model, with their limits
    moving_model      the robot at a frame's time, padded for the filter, or bare
    voxelizer         turns foreground pixels into voxels of the lattice (Algorithms 1, 6 and 7)
    visibility        blocks of the cell that a frame looks through
    fit_check         fit of the measured depth to the expected depth
    pose_misfit       misfit of a frame at the camera's pose, and at neighbouring poses
    pose_refinement   refines the camera's pose by the CAD that it measures
    frame_result      the result of one frame, as one value
    depth_pipeline    the method, one line for each stage
    images            the unit's images as PNG
"""

from edge_unit.pipeline.background_model import BackgroundLearner, BackgroundModel
from edge_unit.pipeline.depth_pipeline import DepthPipeline
from edge_unit.pipeline.expected_depth import BareRobot
from edge_unit.pipeline.frame_result import FrameResult
from edge_unit.pipeline.images import picture_raw, png_of
from edge_unit.pipeline.pose_misfit import Misfit
from edge_unit.pipeline.pose_refinement import Refiner
from edge_unit.pipeline.stage_times import StageTimes
from edge_unit.pipeline.visibility import SeenBlocks
from edge_unit.pipeline.voxelizer import Voxels

__all__ = [
    "BackgroundLearner",
    "BackgroundModel",
    "BareRobot",
    "DepthPipeline",
    "FrameResult",
    "Misfit",
    "Refiner",
    "SeenBlocks",
    "StageTimes",
    "Voxels",
    "picture_raw",
    "png_of",
]
