# SPDX-License-Identifier: Apache-2.0
"""What `make bench-pipeline` races on, and against whom.

In the order of the flow:

    ur3_scene a UR3 in a room, something unknown beside it: what the speed is measured on
    contenders the same work by Open3D, OctoMap and Embree
"""
