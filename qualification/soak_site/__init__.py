# SPDX-License-Identifier: Apache-2.0
"""The cell, the faults and the measurements of `make soak`.

In the order of the flow:

    schedule  times and kinds of faults, drawn from a seed
    usage     memory, threads and handles of processes, and the limits of their growth
    unit      the edge unit with a camera that may be unplugged
    site      a cell with several faults at once
"""
