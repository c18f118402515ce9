# SPDX-License-Identifier: Apache-2.0
"""The robots' joints at a frame's time.

In the order of the flow:

    history               the last seconds of joints, interpolated to a frame's time
    delay_estimation      the delay of the joints' times against the frames' times
    delay_from_recording  the same from a recording
    delay_monitor         the same while a unit runs, as a warning
"""

from edge_unit.joints.delay_estimation import DelayComparison, DelayEstimate, compare_frame, estimate_delay
from edge_unit.joints.delay_from_recording import delay_of_recording
from edge_unit.joints.delay_monitor import DelayMonitor
from edge_unit.joints.history import JointEstimate, JointHistory

__all__ = [
    "DelayComparison",
    "DelayEstimate",
    "DelayMonitor",
    "JointEstimate",
    "JointHistory",
    "compare_frame",
    "delay_of_recording",
    "estimate_delay",
]
