# SPDX-License-Identifier: Apache-2.0
"""What `make sweeps` puts before simulated cameras.

In the order of the flow:

    stage     one camera before one thing: a bare scene whose every pixel is a ray cast by Embree
    thickness how thin a thing on a table may be before it is lost
    shapes    plates and rods that must never be lost, speckle that must be
    quiet     a cell in which nothing but the robot moves: no voxel may be reported
    walkers   people in the simulated cell: how much of them is missed
"""
