# SPDX-License-Identifier: Apache-2.0
"""The edge unit: from a depth frame to the few voxels that nothing known explains.

In the order of the flow:

    tls             which master a unit believes, by its certificate
    sources/        where frames come from
    config          the unit's own configuration
    source_factory  the source that the configuration names
    pipeline/       the method: expected depth, foreground, voxels, density, seen, health
    calibration/    the printed board: layout, PDF, detection, pose
    joints/         where the robots were at a frame's time
    uplink/         the master: discovery, client, cell cache, the exchange
    monitoring/     camera, pose, stalls, stage times, trace, host
    daemon/         the unit at work: frames, tasks, commands
    doctor          a check of all that a unit needs, with what to do about it
    __main__        the command line
"""
