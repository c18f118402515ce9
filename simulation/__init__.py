# SPDX-License-Identifier: Apache-2.0
"""Simulated hardware: a cell, a moving robot, people, and depth cameras with their faults.

Everything is a pure function of a time in seconds and a seed. So processes agree about the world without communication,
and tests need no clock.
In the order of the flow:

    world/    objects, robot and people in the cell
    cameras/  depth cameras, their faults, and the expected reports
    fleet/    master, units and controller as real processes
    demo/     the demo and the README's pictures
"""
