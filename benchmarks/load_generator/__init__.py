# SPDX-License-Identifier: Apache-2.0
"""Simulated senders and readers of a master, for `make bench-master`, `make bench-scale` and others.

In the order of the flow:

    traffic       the updates of units, in the very bytes of their client
    load          a process that sends them for many units, and counts
    bare_fastapi  the route that a master is compared with
    map_readers   two robots that read the map and record the time of each map
    watchers      viewers of the master's map, without browsers
    merge_costs   the cost of the merge itself, by the number of units
    wide_master   a master with a raised limit of units
    scale_load    an increasing number of units for one master
"""
