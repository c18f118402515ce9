# SPDX-License-Identifier: Apache-2.0
"""Who sends to a master and who reads from it, for `make bench-master`, `make bench-scale` and others.

In the order of the flow:

    traffic      what units send, in the very bytes of their client
    load         a process that sends it for many units, and counts
    bare_fastapi what a master is measured against
    map_readers  two robots that read the map, and when they had it
    watchers     people who look at the master's viewer
    merge_costs  what the merge itself costs, by the number of units
    wide_master  a master that takes more units than it should
    scale_load   more and more units before one master
"""
