# SPDX-License-Identifier: Apache-2.0
"""The edge unit: from a depth frame to the few voxels that nothing known explains.

In the order of the flow:

    carried_kernels compiled kernels that came with the release, for a named processor
    jit_cache       where compiled kernels are kept, settled before the first is imported
    kernels/        the arithmetic, as pure numba functions on arrays
    sources/        where frames come from
    recording       a folder of images becomes a recording that the RealSense SDK plays
    inflation       how a mesh grows by a padding
    hull            a link as the solid that reaches a few centimetres around it
    links           the robot's links as they stand before one camera
    drawing         meshes and links drawn into buffers of inverse depth
    expected_depth  what the camera should see: static layer and robot layer (Algorithms 2 to 5)
    halo            what edges of the CAD make the camera see beside them
    reference       the static layer that is learned from the empty cell
    voxels          foreground pixels become voxels of the lattice (Algorithms 1, 6 and 7)
    visibility      which blocks of the cell a frame looks through
    health          does what the camera sees still fit what it should see
    misfit          how badly a frame fits from where the camera should be, and from close by
    refine          the camera's pose, refined by what it measures of the CAD
    pipeline        the method, one line a stage
    pictures        what a unit sees, as PNG
    rehearsal       every kernel, ready before the first frame
    board_layout    the calibration board on paper: what is printed where
    board_detection the board in one picture: which of its points are seen, and where
    board_print     the board as a PDF at exact scale
    pose_mean       the mean of many measurements of one pose
    localise        the camera's pose by the board: pictures in, pose out
    board_search    looks for the board through the source's own pictures
    joints          the robot's joints at a frame's time
    joint_delay     how much later the joints' times are than the frames'
    recorded_delay  the same by a recording
    delay_watch     the same while a unit runs, as a warning
    trust           which master a unit believes, by its certificate
    config          the unit's own configuration
    source_choice   the source that the configuration chose
    master_choice   which of the masters that were heard of is ours
    master_search   looks for the master while it does not answer
    client          what a unit can ask the master
    cell_cache      the master's cell, kept on disk
    stages          how long a frame spent in each stage of the unit
    uplink          the exchange with the master: latest wins
    host            what the computer itself tells: its boot, its clock, its USB
    camera_memory   the camera that was here, so that its absence can be told
    camera_standing how the camera is doing, told to the master
    orders          what the master asked for, by when it is carried out
    frame_joints    where the robot was when a frame was taken
    background      the learned reference, kept on disk
    learning        the background found on disk, or learned from frames
    stance          does the camera still stand where its pose was found
    assigned_pipeline  the pipeline as the master's latest assignment has it
    refining        the pose refined while frames come
    reporting       a frame as a report: voxels, seen blocks, health
    frame_work      everything about a frame that takes time
    board_pose      the pose by the board, found and told to the master
    errands         work that no frame waits for
    showing         the pictures that people ask for
    trace           what was reported, frame by frame, in a file
    progress        whether the work on frames makes progress
    unit            the daemon: source, pipeline and uplink held together
    doctor          is all there that a unit needs, and what is to be done if not
    __main__        the command line
"""

from edge_unit.jit_cache import settle

settle()
