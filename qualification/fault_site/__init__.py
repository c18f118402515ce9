# SPDX-License-Identifier: Apache-2.0
"""What `make faults` breaks, and who watches the map meanwhile.

In the order of the flow:

    scene  what stands before the cameras of the fault table, and which blocks it fills
    unit   the edge unit before a camera whose picture may be exchanged
    clock  other clocks for one process
    watch  asks for the map all the time, and holds the answers against the truth
    site   a master, two units and a robot, and all that may be done to them
"""
