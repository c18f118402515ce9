# SPDX-License-Identifier: Apache-2.0
"""What `make soak` lets happen, and what it counts.

In the order of the flow:

    schedule  what happens to a cell when, drawn from a seed
    usage     memory, threads and handles of processes, and what counts as growth
    unit      the edge unit before a camera that may be unplugged
    site      a cell that all sorts of things happen to at once
"""
