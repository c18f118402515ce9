# SPDX-License-Identifier: Apache-2.0
"""Whether the camera, the computer and the work on frames are as they should be.

In the order of the flow:

    host            the computer: its boot, its clock, its USB
    stage_timer     how long a frame spent in each stage of the unit
    stall_detector  whether the work on frames makes progress
    last_camera     the camera of the last run, so that its absence can be told
    camera_status   the camera's status, told to the master
    pose_monitor    whether the camera still stands where its pose was found
    trace           what was reported, frame by frame, in a file
"""

from edge_unit.monitoring.camera_status import CameraStatus
from edge_unit.monitoring.host import boot_id, clock_is_set, usb_cameras
from edge_unit.monitoring.pose_monitor import PoseMonitor, Verdict, place_of
from edge_unit.monitoring.stage_timer import StageTimer
from edge_unit.monitoring.stall_detector import StallDetector
from edge_unit.monitoring.trace import Trace, TraceRecord, read_trace

__all__ = [
    "CameraStatus",
    "StallDetector",
    "StageTimer",
    "PoseMonitor",
    "Trace",
    "TraceRecord",
    "Verdict",
    "boot_id",
    "clock_is_set",
    "place_of",
    "read_trace",
    "usb_cameras",
]
