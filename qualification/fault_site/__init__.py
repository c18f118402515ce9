# SPDX-License-Identifier: Apache-2.0
"""Processes that `make faults` breaks, and the observers of the map.

In the order of the flow:

    scene  the view of both cameras, and the blocks that its things fill
    unit   the edge unit with a camera whose image can be exchanged
    clock  separate clocks for one process
    watch  polls the map all the time, and compares the answers with the truth
    site   a master, two units and a robot, and all actions on them
"""
