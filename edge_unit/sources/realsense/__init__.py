# SPDX-License-Identifier: Apache-2.0
"""A RealSense camera, captured by a process of its own, which alone loads the SDK.

That process must start fast, so this page re-exports nothing. In the order of the flow:

    sdk                 the RealSense SDK, and its libusb before it
    profiles            which of the pictures on offer comes nearest
    camera_clock        the camera's time stamps on our clock
    capture_link        what the capture process is asked, and what it tells
    shared_frames       frames in memory that both processes see
    devices             which cameras the SDK sees, and the one that is wanted
    frame_clock         when the SDK took a frame
    stream              one stream of one camera or recording
    recorder            recordings written from images
    capture             from looking for the camera to whatever ends it
    capture_process     the process in which that is done
    watchdog            when it counts as stuck, and how the next one begins
    capture_session     one such process in the hands of the unit
    capture_supervisor  one such process after the other
    source              the source
    bag_writer          a folder of images as a recording that the SDK plays
"""
