# SPDX-License-Identifier: Apache-2.0
"""Everything that pretends to be hardware: a cell, a moving robot, people, depth cameras with their faults.

All of it is a pure function of a time in seconds and a seed: processes agree about the world without talking,
and tests need no clock. In the order of the flow:

    world/    what stands and moves in the cell
    cameras/  depth cameras, their faults and what they should report
    fleet/    master, units and controller as real processes
    demo/     the demo and the README's pictures
"""
