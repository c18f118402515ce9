# SPDX-License-Identifier: Apache-2.0
"""Where `make plug-and-play` plugs its units in.

In the order of the flow:

    switch  a switch with sockets for units, each with a network of its own
    site    a master, a robot and units that are given nothing but a token
    judge   where their cameras really hang, and what of their voxels is robot
"""
