# SPDX-License-Identifier: Apache-2.0
"""Parts of the paper's experiment, `make bench-paper`.

In the order of the flow:

    scene       the paper's cell: a UR3, a person, four cameras
    contenders  one unit at its frame, all cameras in one process, all cameras into one octree
    master      a real master, and the clients that bring voxels to it
    book        the measurements by contender, resolution, voxel size and number of cameras
    composed    a refresh if each unit had a computer of its own, in turns with the centralised ways
    unit        one unit as a process
    running     a refresh by such processes on this machine
    tables      the paper's tables anew, beside the figures that it states
"""
