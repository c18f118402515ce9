# SPDX-License-Identifier: Apache-2.0
"""Objects, robot and people in the simulated cell.

In the order of the flow:

    scene       all bodies at one moment, and their owners
    robot_path  motion of the robot
    people      people who walk and reach, as capsules
    world       a cell with its robot, people and unknown objects
    handling    handling of a camera by people: knock it, cover it, plug in another
"""
