# SPDX-License-Identifier: Apache-2.0
"""The edge unit: from a depth frame to the few voxels that nothing known explains.

In the order of the flow:

    jit_cache       where compiled kernels are kept, settled before the first is imported
    config          the unit's own configuration
    kernels/        the arithmetic, as pure numba functions on arrays
    sources/        where frames come from
    inflation       how a mesh grows by a padding
    expected_depth  what the camera should see: static layer and robot layer (Algorithms 2 to 5)
    reference       the static layer that is learned from the empty cell
    voxels          foreground pixels become voxels of the lattice (Algorithms 1, 6 and 7)
    visibility      which blocks of the cell a frame looks through
    health          does what the camera sees still fit what it should see
    pipeline        the method, one line a stage
    joints          the robot's joints at a frame's time
    uplink          the exchange with the master: latest wins
    trace           what was reported, frame by frame, in a file
    unit            the daemon: source, pipeline and uplink held together
    __main__        the command line
"""
