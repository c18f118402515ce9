# SPDX-License-Identifier: Apache-2.0
"""The method: from a depth frame, its joints and all that is known to voxels of what is not known.

In the order of the flow:

    stage_times       how long a frame spends in each stage
    expected_depth    what the camera should see: static layer and robot layer (Algorithms 2 to 5)
    edge_halo         what edges of the CAD make the camera see beside them
    background_model  the static layer that is learned of the empty cell
    static_model      all that stands still: CAD, known objects, background, with their limits
    moving_model      the robot at a frame's time, padded for the filter, or bare
    voxelizer         foreground pixels become voxels of the lattice (Algorithms 1, 6 and 7)
    visibility        which blocks of the cell a frame looks through
    fit_check         whether what the camera sees fits what it should see
    pose_misfit       how badly a frame fits from where the camera should be, and from close by
    pose_refinement   the camera's pose, refined by what it measures of the CAD
    frame_result      all that one frame tells, as one value
    depth_pipeline    the method, one line a stage
    images            what a unit sees, as PNG
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
    "BareRobot",
    "DepthPipeline",
    "FrameResult",
    "Misfit",
    "BackgroundModel",
    "BackgroundLearner",
    "Refiner",
    "SeenBlocks",
    "StageTimes",
    "Voxels",
    "picture_raw",
    "png_of",
]
