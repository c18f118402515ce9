# SPDX-License-Identifier: Apache-2.0
"""What `make bench-latency` follows from camera to robot.

In the order of the flow:

    frames what simulated cameras see, rendered beforehand
    unit   the edge unit before a camera that plays such frames
"""
