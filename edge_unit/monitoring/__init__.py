# SPDX-License-Identifier: Apache-2.0
"""Health of the camera, of the computer and of the work on frames.

In the order of the flow:

    host            the computer: its boot, its clock, its USB
    stage_timer     how long a frame spent in each stage of the unit
    stall_detector  detects work on frames that does not end in time
    last_camera     the camera of the last run, so that its absence can be reported
    camera_status   the camera's status, reported to the master
    pose_monitor    detects a camera that was moved or covered
    trace           a file of all reports, frame by frame
"""

from edge_unit.monitoring.camera_status import CameraStatus
from edge_unit.monitoring.host import boot_id, clock_is_set, usb_cameras
from edge_unit.monitoring.pose_monitor import PoseMonitor, Verdict, place_of
from edge_unit.monitoring.stage_timer import StageTimer
from edge_unit.monitoring.stall_detector import StallDetector
from edge_unit.monitoring.trace import Trace, TraceRecord, read_trace

__all__ = [
    "CameraStatus",
    "PoseMonitor",
    "StageTimer",
    "StallDetector",
    "Trace",
    "TraceRecord",
    "Verdict",
    "boot_id",
    "clock_is_set",
    "place_of",
    "read_trace",
    "usb_cameras",
]
