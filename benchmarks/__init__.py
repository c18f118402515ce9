# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of Cellwatch: each command is one module here; its helpers are in the folder listed before it.

Each command prints its tables and writes them as JSON to `out/results/`. `REPORT.md` shows the results of `baseline/`.
In the order of the flow:

    reporting/         tables and marks, JSON results, and the page of all results
    sweep_scenes/      the scenes of `make sweeps`
    sweeps             all sweeps, as one table
    pose_monitor       time until a knocked camera is reported, and rate of false alarms
    joint_delivery     simulated delivery of joints to the master: late, jittering, some lost
    right_time         robot filtering with late, jittering or rare joints
    board              error of a camera pose from a calibration board
    real_frames        the real recordings, and their ground truth
    real               a real master and a real unit on the recordings, judged frame by frame
    ground_truth/      scenes, rules and judges of `make bench-accuracy`
    accuracy           all trials, as one run
    peers/             peers and scene of `make bench-pipeline`
    pipeline           cost of a frame, in turns with the peers
    load_generator/    simulated senders and readers of a master
    master             load test of one master
    scale              one master with an increasing number of units, up to its limit
    latency_probe/     cameras and units of `make bench-latency`
    latency            time from a frame's capture to the map at a robot, by stage
    paper_experiment/  parts of `make bench-paper`
    paper              the paper's experiment, in one command
    bench              the parts that fit into twenty minutes, and the page
"""
