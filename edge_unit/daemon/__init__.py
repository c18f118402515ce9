# SPDX-License-Identifier: Apache-2.0
"""The daemon: one frame after the other, and the background tasks.

It is the last room: only the command line imports from it. In the order of the flow:

    task_group           background tasks, which no frame waits for
    command_batch        the master's commands, sorted by the time of their execution
    warm_up              every kernel, ready before the first frame
    report               a frame as a report: voxels, seen blocks, health
    joint_lookup         the joints at a frame's time
    background_store     the background model, kept on disk
    background_learning  the background model found on disk, or learned from frames
    pipeline_manager     the pipeline as the master's latest assignment has it
    refinement_task      the pose refined while frames come
    frame_processor      all that is done with one frame
    frame_limiter        drops frames beyond `fps_max`
    calibration_task     finds the pose from the board and reports it to the master
    image_requests       renders and sends the images that the master requests
    unit_status          the state of a unit in one line
    unit                 the daemon: joins source, pipeline and uplink
"""
