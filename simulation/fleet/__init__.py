# SPDX-License-Identifier: Apache-2.0
"""A master, units and a robot's controller as real processes.

In the order of the flow:

    evaluation      what units reported, held against what was there
    processes       child processes that never outlive their parent
    running_master  a real master as such a process
    controller      the robot's controller: reports its joints to the master
    power           the switch at the units, for whoever watches
    warm_up         compiles what a simulated unit needs, once for many
    fleet           a master, its units and the controller as real processes
"""
