# SPDX-License-Identifier: Apache-2.0
"""Where frames come from; chosen by one word of configuration.

In the order of the flow:

    frame       a frame, a camera's identity, and what every source can do
    image       a picture that is not depth, for the calibration board
    status      how a source is doing, told without a frame
    recorded    a folder of 16-bit PNG images with intrinsics, poses and joints
    simulated   a depth camera in the simulated cell
    realsense/  a RealSense camera, in a process of its own
"""

from edge_unit.sources.frame import CameraInfo, DepthFrame, DepthSource
from edge_unit.sources.status import ReportsStatus, SourceStatus

__all__ = [
    "CameraInfo",
    "DepthFrame",
    "DepthSource",
    "ReportsStatus",
    "SourceStatus",
]
