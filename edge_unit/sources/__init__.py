# SPDX-License-Identifier: Apache-2.0
"""Sources of frames; one word of configuration chooses one.

The capture process must load little and start fast, so this package re-exports nothing.

In the order of the flow:

    frame             a frame, a camera's identity, and the interface of every source
    image             an image other than depth, for the calibration board
    status            the status of a source, reported without a frame
    camera_info_file  a camera's intrinsics from a file, in the forms that drivers and calibrators write
    recorded          a folder of 16-bit PNG images with intrinsics, poses and joints
    simulated         a depth camera in the simulated cell
    realsense/        a RealSense camera, in a process of its own
"""
