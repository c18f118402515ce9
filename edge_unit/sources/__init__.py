# SPDX-License-Identifier: Apache-2.0
"""Where frames come from; chosen by one word of configuration.

The process that captures frames loads little and starts fast, so this page re-exports nothing.

In the order of the flow:

    frame       a frame, a camera's identity, and what every source can do
    image       a picture that is not depth, for the calibration board
    status      how a source is doing, told without a frame
    camera_info_file    a camera's intrinsics from a file, in the forms that drivers and calibrators write
    recorded    a folder of 16-bit PNG images with intrinsics, poses and joints
    simulated   a depth camera in the simulated cell
    realsense/  a RealSense camera, in a process of its own
"""
