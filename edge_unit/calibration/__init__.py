# SPDX-License-Identifier: Apache-2.0
"""The printed calibration board, and the camera's pose from it.

OpenCV's detector and the PDF writer are loaded only on use, so this package re-exports nothing.
In the order of the flow:

    board_layout     the calibration board on paper: positions of all printed parts
    board_pdf        the board as a PDF at exact scale
    board_detection  the board in one image: its seen points and their pixels
    pose_average     the mean of many measurements of one pose
    board_pose       the camera's pose from images of the board
    board_scan       searches for the board in the source's own images
"""
