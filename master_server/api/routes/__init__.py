# SPDX-License-Identifier: Apache-2.0
"""The master as HTTP: each module translates one part of it, and decides nothing.

In the order of the flow:

    common    bodies in bounds, JSON or msgpack, tokens
    sockets   a WebSocket served until one side goes
    update    `POST /update`, the path that every frame of every unit takes
    units     registering, and what is known of each unit
    images    a unit's pictures, on request
    cell      the cell's document and meshes
    map       the merged map, the coverage, the history and the settings
    stream    the merged map as it changes
    robot     the robot's joints
    recording  recording what the master sees
    replay    a recording played, in place of a master
    health    whether the master lives, and how it fares
"""
