# SPDX-License-Identifier: Apache-2.0
"""The edge unit: turns a depth frame into the few voxels of unknown obstacles.

In the order of the flow:

    tls             trust in a master, by its certificate
    sources/        sources of frames
    config          the unit's own configuration
    source_factory  the source that the configuration names
    pipeline/       the method: expected depth, foreground, voxels, density, seen, health
    calibration/    the printed board: layout, PDF, detection, pose
    joints/         the robots' joints at a frame's time
    uplink/         the master: discovery, client, cell cache, the exchange
    monitoring/     camera, pose, stalls, stage times, trace, host
    daemon/         the running unit: frames, tasks, commands
    doctor          a check of a unit's requirements, with remedies
    __main__        the command line
"""
