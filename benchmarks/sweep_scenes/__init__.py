# SPDX-License-Identifier: Apache-2.0
"""Scenes of `make sweeps`.

In the order of the flow:

    stage      one camera before one thing: a bare scene, with a ray cast by Embree for each pixel
    thickness  thinnest thing on a table that is still reported
    shapes     plates and rods that must never be lost, speckle that must be
    quiet      a cell in which only the robot moves: no voxel may be reported
    walkers    people in the simulated cell: the share of them that is missed
"""
