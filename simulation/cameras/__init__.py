# SPDX-License-Identifier: Apache-2.0
"""Depth cameras in that cell: what they see, with which faults, and what they should report.

In the order of the flow:

    raster         true depth, fast: our own z-buffer, capsules by formula
    raycast        true depth, independent: rays cast by Embree
    depth_noise    the faults of a stereo depth camera
    truth          which voxels should be reported, and which must not
    camera         a depth camera in the world, and where a cell's cameras hang
    board_picture  what a camera's picture shows of the calibration board
    pluggable      RealSense cameras that are plugged in and out: recordings on the SDK's context
"""
