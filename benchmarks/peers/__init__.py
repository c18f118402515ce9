# SPDX-License-Identifier: Apache-2.0
"""Peers and scene of `make bench-pipeline`.

In the order of the flow:

    ur3_scene   the scene of the speed test: a UR3 in a room, something unknown beside it
    contenders  the same work by Open3D, OctoMap, DUFOMap and Embree
"""
