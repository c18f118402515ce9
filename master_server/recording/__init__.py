# SPDX-License-Identifier: Apache-2.0
"""The state of the master over time: written to files and played back.

A replay does not need the modules that write, so this page re-exports nothing. In the order of the flow:

    moment            one recorded moment, and its form in a recording
    foxglove          a moment in the schemas that Foxglove displays
    recording_file    one file of a recording
    recorder          files one after another, in a thread that nothing waits for
    recording_reader  opens a recording for reading
    timeline          the files of one recording as one
    replay            answers from a recording as the master did
"""
