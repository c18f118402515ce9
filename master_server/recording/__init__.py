# SPDX-License-Identifier: Apache-2.0
"""What the master saw, written to files and played back.

Who plays a recording needs none of what writes one, so this page re-exports nothing. In the order of the flow:

    moment            a moment to be recorded, and what a recording holds of it
    foxglove          such a moment in the schemas that Foxglove shows
    recording_file    one file of a recording
    recorder          files one after another, in a thread that nothing waits for
    recording_reader  a recording opened for reading
    timeline          the files of one recording as one
    replay            a recording that answers as the master did
"""
