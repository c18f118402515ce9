# SPDX-License-Identifier: Apache-2.0
"""What the filter is worth, in figures; each run prints its table and leaves it as JSON in `results/`.

In the order of the flow:

    circumstances when, on what machine and of which state of the source a figure was taken
    report     tables and curves for people, marks, and one line of JSON for machines
    stage      one camera before one thing: a bare scene whose every pixel is a ray cast by Embree
    thickness  how thin a thing on a table may be before it is lost
    shapes     plates and rods that must never be lost, speckle that must be
    quiet      a cell in which nothing but the robot moves: no voxel may be reported
    walkers    people in the simulated cell: how much of them is missed
    sweeps     all of these, as one table
    stance     how soon a knocked camera is told, and how often one that hangs still is suspected
    joint_delivery a robot's joints as they reach the master: late, jittering, some lost
    right_time the robot filtered where it was when the frame was taken
    board      how well a camera's pose is found by a calibration board
    real_frames the real recordings, and what must come out of them
    real         a real master and a real unit on them, judged frame by frame
    accuracy_stage a camera askew to the lattice, a wall, and a thing of a known shape between them
    accuracy_rules what is compared: ours, the paper's own rule, a least number of points
    accuracy_truth what was reported, held against the surface that was there
    accuracy_trials all of them before the same frames
    accuracy_curves what came of it as curves, tables and words
    accuracy_real the real recordings, frame by frame
    accuracy_plan who is compared before what, and how often
    accuracy     all of it, as one run
    source_faults what a RealSense source does when the camera makes trouble
    fault_scene  what stands before the cameras of the fault table, and which blocks it fills
    fault_unit   the edge unit before a camera whose picture may be exchanged
    fault_clock  other clocks for one process
    fault_network a cable that can be pulled, and a proxy that is slow, cuts and remembers
    fault_watch  asks for the map all the time, and holds the answers against the truth
    fault_site   a master, two units and a robot, and all that may be done to them
    faults       what the map says while processes, clocks, networks and disks fail
    soak_schedule what happens to a cell when, drawn from a seed
    soak_usage   memory, threads and handles of processes, and what counts as growth
    soak_unit    the edge unit before a camera that may be unplugged
    soak_site    a cell that all sorts of things happen to at once
    soak         for as long as is wished: no answer wrong, nothing grows
    plug_network  a switch with sockets for units, each with a network of its own
    plug_site     a master, a robot and units that are given nothing but a token
    plug_judge    where their cameras really hang, and what of their voxels is robot
    plug_and_play units are plugged in, moved, exchanged, knocked and covered
    ur3_scene    a UR3 in a room, something unknown beside it: what the speed is measured on
    peers        the same work by Open3D, OctoMap and Embree
    pipeline     what a frame costs, in turns with them
    traffic      what units send, in the very bytes of their client
    load         a process that sends it for many units, and counts
    bare_fastapi what a master is measured against
    map_readers  two robots that read the map, and when they had it
    watchers     people who look at the master's viewer
    master       what one master bears
    merge_costs  what the merge itself costs, by the number of units
    wide_master  a master that takes more units than it should
    scale_load   more and more units before one master
    scale        one master and more and more units, until it bends
    latency_frames what simulated cameras see, rendered beforehand
    latency_unit the edge unit before a camera that plays such frames
    latency      where the milliseconds go from a frame's capture to a robot's map
    viewer       the operator's window in a real browser, and what those who look cost the units
    machines     machines that boot systemd from one read-only root file system
    rehearsal    three units and a master as such machines: switched on, failing, coming back
    image_parts  the image that arm64 boards boot in QEMU, built as a board's is
    emulated     one such board
    image_test   two of them boot from one image and report to a master
    paper_scene  the paper's cell: a UR3, a person, four cameras
    paper_contenders one unit at its frame, all cameras in one process, all cameras into one octree
    paper_master a real master, and what it takes to bring voxels to it
    paper_book   what was measured, by contender, resolution, voxel size and number of cameras
    paper_composed a refresh if each unit had a computer of its own, in turns with the centralised ways
    paper_unit   one unit as a process
    paper_running a refresh by such processes on this machine
    paper_tables the paper's tables anew, and beside them what it states
    paper        the paper's experiment, in one command
    parts        each part of the report: its command, the question that it answers, how long it may take
    plots        curves as pictures
    report_page  all results as one page
    bench        those that fit into twenty minutes, and the page
"""
