# SPDX-License-Identifier: Apache-2.0
"""A master, units and a robot's controller as real processes.

In the order of the flow:

    truth_file      the truth of each frame of a simulated camera, in a file
    evaluation      compares the reports of units with that truth
    processes       child processes that never outlive their parent
    running_master  a real master as such a process
    controller      the robot's controller: reports its joints to the master
    power           the power switch of the units, as buttons in the viewer
    warm_up         compiles the kernels of simulated units, once for all
    unit            the edge unit with a simulated camera that is evaluated
    fleet           a master, its units and the controller as real processes
"""
