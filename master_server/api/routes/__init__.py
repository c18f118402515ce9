# SPDX-License-Identifier: Apache-2.0
"""The HTTP routes: each module translates one part of the master, and decides nothing.

In the order of the flow:

    common    bounded bodies, JSON or msgpack, tokens
    sockets   serves a WebSocket until one side ends it
    update    `POST /update`, the path of every frame of every unit
    units     registration, and the state of each unit
    images    a unit's images, on request
    cell      the cell's document and meshes
    map       the merged map, the coverage, the history and the settings
    stream    the merged map as it changes
    robot     the robot's joints
    recording  starts and stops recordings
    replay    controls a replay, in place of a master
    health    liveness and metrics
"""
