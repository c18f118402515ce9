# SPDX-License-Identifier: Apache-2.0
"""What Cellwatch is worth, in figures: each command is one module here, its helpers are in the folder listed before it.

Each prints its tables and leaves them as JSON in `out/results/`; `REPORT.md` shows those of `baseline/`.

In the order of the flow:

    reporting/         figures for people and machines, and all of them as one page
    sweep_scenes/      what `make sweeps` puts before simulated cameras
    sweeps             all of it, as one table
    pose_monitor       how soon a knocked camera is told, and how often one that hangs still is suspected
    joint_delivery     a robot's joints as they reach the master: late, jittering, some lost
    right_time         the robot filtered where it was when the frame was taken
    board              how well a camera's pose is found by a calibration board
    real_frames        the real recordings, and what must come out of them
    real               a real master and a real unit on them, judged frame by frame
    ground_truth/      what `make bench-accuracy` judges, and by which truth
    accuracy           all of it, as one run
    peers/             what `make bench-pipeline` races on, and against whom
    pipeline           what a frame costs, in turns with them
    load_generator/    who sends to a master and who reads from it
    master             what one master bears
    scale              one master and more and more units, until it bends
    latency_probe/     what `make bench-latency` follows from camera to robot
    latency            where the milliseconds go from a frame's capture to a robot's map
    paper_experiment/  the rooms of the paper's experiment, `make bench-paper`
    paper              the paper's experiment, in one command
    bench              those that fit into twenty minutes, and the page
"""
