# SPDX-License-Identifier: Apache-2.0
"""A RealSense camera; a process of its own captures it, and only that process loads the SDK.

That process must start fast, so this package re-exports nothing. In the order of the flow:

    sdk                 loads the RealSense SDK, and its libusb before it
    profiles            the offered profile that is closest to the configured one
    camera_clock        converts the camera's time stamps to the unit's clock
    capture_link        messages between the unit and the capture process
    shared_frames       frames in memory that both processes share
    devices             the SDK's cameras, and the configured one among them
    frame_clock         capture time of an SDK frame
    stream              one stream of one camera or recording
    recorder            recordings written from images
    capture             one capture, from the search for the camera to its end or failure
    capture_process     the process that runs a capture
    watchdog            time limits of a capture process, and the delay of its restart
    capture_session     handle of one capture process in the unit
    capture_supervisor  runs one capture process after the other
    source              the source
    bag_writer          converts a folder of images to a recording that the SDK plays
"""
