# SPDX-License-Identifier: Apache-2.0
"""The printed board and the camera's pose by it.

OpenCV's detector and the PDF's writer are loaded by who needs them, so this page re-exports nothing.
In the order of the flow:

    board_layout     the calibration board on paper: what is printed where
    board_pdf        the board as a PDF at exact scale
    board_detection  the board in one picture: which of its points are seen, and where
    pose_average     the mean of many measurements of one pose
    board_pose       the camera's pose by the board: pictures in, pose out
    board_scan       looks for the board through the source's own pictures
"""
