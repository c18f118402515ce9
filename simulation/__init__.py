# SPDX-License-Identifier: Apache-2.0
"""Everything that pretends to be hardware: a cell, a moving robot, people, depth cameras with their faults.

All of it is a pure function of a time in seconds and a seed: processes agree about the world without talking,
and tests need no clock. In the order of the flow:

    scene        what stands where at one moment, and whose it is
    robot_path   how the robot moves
    people       people who walk and reach, as capsules
    world        a cell with its robot, people and unknown things
    raster       true depth, fast: our own z-buffer, capsules by formula
    raycast      true depth, independent: rays cast by Embree
    depth_noise  the faults of a stereo depth camera
    truth        which voxels should be reported, and which must not
    board_picture what a camera's picture shows of the calibration board
    camera       a depth camera in the world, and where a cell's cameras hang
    handling     what people do to a camera: they knock it, cover it, plug in another
    controller   the robot's controller: reports its joints to the master
    warm_up      compiles what a simulated unit needs, once for many
    evaluation   what units reported, held against what was there
    processes    child processes that never outlive their parent
    running_master a real master as such a process
    power        the switch at the units, for whoever watches
    fleet        a master, its units and the controller as real processes
    table        the demo's live table
    show         the demo itself
    demo         the command line
    picture      the README's picture
    window_pictures the README's pictures of the operator's window
    pluggable    RealSense cameras that are plugged in and out: recordings on the SDK's context
"""
