# SPDX-License-Identifier: Apache-2.0
"""What stands and moves in the simulated cell.

In the order of the flow:

    scene       what stands where at one moment, and whose it is
    robot_path  how the robot moves
    people      people who walk and reach, as capsules
    world       a cell with its robot, people and unknown things
    handling    what people do to a camera: they knock it, cover it, plug in another
"""
