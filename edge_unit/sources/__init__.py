# SPDX-License-Identifier: Apache-2.0
"""Where frames come from; chosen by one word of configuration.

First the seam, then what stands behind it:

    frame      a frame, a camera's identity, and what every source can do
    image      a picture that is not depth, for the calibration board
    recorded   a folder of 16-bit PNG images with intrinsics, poses and joints
    simulated  a depth camera in the simulated cell

A RealSense camera is captured by a process of its own, which alone loads the SDK:

    status              how a source is doing, told without a frame
    profiles            which of the pictures on offer comes nearest
    camera_clock        the camera's time stamps on our clock
    capture_link        what the capture process is asked, and what it tells
    shared_frames       frames in memory that both processes see
    sdk_devices         which cameras the SDK sees, and the one that is wanted
    sdk_clock           when a frame of the SDK was taken
    sdk_stream          one stream of one camera or recording
    sdk_recorder        recordings written from images
    capture             from looking for the camera to whatever ends it
    capture_process     the process in which that is done
    watchdog            when it counts as stuck, and how the next one begins
    capture_session     one such process in the hands of the unit
    capture_supervisor  one such process after the other
    realsense           the source
"""
