# SPDX-License-Identifier: Apache-2.0
"""Where frames come from; chosen by one word of configuration.

First the seam, then what stands behind it:

    frame      a frame, a camera's identity, and what every source can do
    recorded   a folder of 16-bit PNG images with intrinsics, poses and joints
    simulated  a depth camera in the simulated cell
"""
