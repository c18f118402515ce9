# SPDX-License-Identifier: Apache-2.0
"""Cameras and units of `make bench-latency`.

In the order of the flow:

    frames  renders the frames of the simulated cameras beforehand
    unit    the edge unit with a camera that plays these frames
"""
