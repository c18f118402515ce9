# SPDX-License-Identifier: Apache-2.0
"""Depth cameras in the simulated cell: their images, their faults, and the expected reports.

In the order of the flow:

    raster         true depth, fast: our own z-buffer, and capsules by formula
    raycast        true depth, independent: rays cast by Embree
    depth_noise    the faults of a stereo depth camera
    truth          voxels that should be reported, and voxels that must not
    camera         a depth camera in the world, and the positions of a cell's cameras
    board_picture  images of the calibration board
    pluggable      RealSense cameras that are plugged in and out: recordings on the SDK's context
"""
