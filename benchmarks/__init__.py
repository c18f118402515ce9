# SPDX-License-Identifier: Apache-2.0
"""What Cellwatch is worth, in figures: each command is one module here, its helpers are in the folder listed before it.

Each prints its tables and leaves them as JSON in `results/`; `REPORT.md` shows all of them.

In the order of the flow:

    circumstances  when, on what machine and of which state of the source a figure was taken
    report         tables and curves for people, marks, and one line of JSON for machines
    sweeping/      what `make sweeps` puts before simulated cameras
    sweeps         all of it, as one table
    stance         how soon a knocked camera is told, and how often one that hangs still is suspected
    joint_delivery a robot's joints as they reach the master: late, jittering, some lost
    right_time     the robot filtered where it was when the frame was taken
    board          how well a camera's pose is found by a calibration board
    real_frames    the real recordings, and what must come out of them
    real           a real master and a real unit on them, judged frame by frame
    judging/       what `make bench-accuracy` judges, and by which truth
    accuracy       all of it, as one run
    source_faults  what a RealSense source does when the camera makes trouble
    faulting/      what `make faults` breaks, and who watches the map meanwhile
    faults         what the map says while processes, clocks, networks and disks fail
    soaking/       what `make soak` lets happen, and what it counts
    soak           for as long as is wished: no answer wrong, nothing grows
    plugging/      where `make plug-and-play` plugs its units in
    plug_and_play  units are plugged in, moved, exchanged, knocked and covered
    racing/        what `make bench-pipeline` races on, and against whom
    pipeline       what a frame costs, in turns with them
    loading/       who sends to a master and who reads from it, for `make bench-master`, `make bench-scale` and others
    master         what one master bears
    scale          one master and more and more units, until it bends
    timing/        what `make bench-latency` follows from camera to robot
    latency        where the milliseconds go from a frame's capture to a robot's map
    viewer         the operator's window in a real browser, and what those who look cost the units
    booting/       machines that boot, for `make rehearsal` and `make image-test`
    rehearsal      three units and a master as such machines: switched on, failing, coming back
    image_test     two of them boot from one image and report to a master
    repeating/     the rooms of the paper's experiment, `make bench-paper`
    paper          the paper's experiment, in one command
    parts          each part of the report: its command, the question that it answers, how long it may take
    plots          curves as pictures
    report_page    all results as one page
    bench          those that fit into twenty minutes, and the page
"""
