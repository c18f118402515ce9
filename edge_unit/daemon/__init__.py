# SPDX-License-Identifier: Apache-2.0
"""The unit at work: one frame after the other, and the tasks beside them.

It is the last room, so nothing imports from it but the command line. In the order of the flow:

    task_group           background tasks, which no frame waits for
    command_batch        the master's commands, by when they are carried out
    warm_up              every kernel, ready before the first frame
    report               a frame as a report: voxels, seen blocks, health
    joint_lookup         the joints at a frame's time
    background_store     the background model, kept on disk
    background_learning  the background model found on disk, or learned from frames
    pipeline_manager     the pipeline as the master's latest assignment has it
    refinement_task      the pose refined while frames come
    frame_processor      all that is done with one frame
    frame_limiter        frames beyond `fps_max` are passed over
    calibration_task     the pose by the board, found and told to the master
    image_requests       the images that people ask for
    unit_status          how a unit fares, in one line
    unit                 the daemon: source, pipeline and uplink held together
"""
