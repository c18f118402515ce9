# SPDX-License-Identifier: Apache-2.0
"""The network, the units and the judge of `make plug-and-play`.

In the order of the flow:

    switch  a switch with sockets for units, each in its own network
    site    a master, a robot and units whose only input is a token
    judge   true poses of their cameras, and voxels of the robot in their reports
"""
