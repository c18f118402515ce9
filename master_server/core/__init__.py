# SPDX-License-Identifier: Apache-2.0
"""The merge and its inputs, without a network.

In the order of the flow:

    robot_joints  the robot's joints, as a short history
    coverage      the blocks that the units see, united
    merged_map    the units' voxels, merged (Algorithm 9)
    units         the units' slots and the trust in each unit (Algorithm 8)
    master        combines all of these
    ticker        ticks the master by the clock
    read_model    the interface of readers: a master, or a recording of one
"""

from master_server.core.master import MapView, Master
from master_server.core.merged_map import MergedMap
from master_server.core.read_model import Readable, ReadableCell
from master_server.core.robot_joints import RobotJoints
from master_server.core.ticker import Ticker
from master_server.core.units import Registry, UnitState

__all__ = [
    "MapView",
    "Master",
    "MergedMap",
    "Readable",
    "ReadableCell",
    "Registry",
    "RobotJoints",
    "Ticker",
    "UnitState",
]
