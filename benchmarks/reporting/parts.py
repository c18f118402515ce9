# SPDX-License-Identifier: Apache-2.0
"""Parts of the report: each part's command, its time limit, and the question that it answers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Part:
    """One program of `benchmarks` or `qualification` that writes `out/results/NAME.json`."""

    module: str
    """Dotted name of the program. It runs as a process, so this package imports nothing of `qualification`."""

    target: str
    """Target of `make` that runs the part alone."""

    title: str
    question: str
    limit_s: float | None = None
    """Time limit of the part in `make bench`. None: the part runs only by itself."""

    arguments: tuple[str, ...] = ()
    """Arguments that `make bench` passes."""

    @property
    def name(self) -> str:
        """Return the name of the result: the last part of the module's."""
        return self.module.rpartition(".")[2]


PARTS = (
    Part(
        "benchmarks.pipeline",
        "bench-pipeline",
        "Cost of a frame",
        "How long does one core need from depth and joints to voxels, and how long do its peers need?",
        limit_s=300.0,
    ),
    Part(
        "benchmarks.scale",
        "bench-scale",
        "Number of units for one master",
        "What does each further unit cost, how old is the map at a robot, and how many units are too many?",
        limit_s=400.0,
    ),
    Part(
        "benchmarks.latency",
        "bench-latency",
        "From a frame to a robot's map",
        "How long does each stage take from the capture of a frame to the map at a robot?",
        limit_s=240.0,
    ),
    Part(
        "benchmarks.paper",
        "bench-paper",
        "The paper's experiment",
        "How long does a refresh of the map by one to four cameras take: with a unit at each, or in one computer?",
        limit_s=480.0,
    ),
    Part(
        "benchmarks.real",
        "real",
        "Real frames of a real robot",
        "How much of the known robot leaks into the map, and how much of an unknown robot is missed?",
        limit_s=200.0,
    ),
    Part(
        "benchmarks.accuracy",
        "bench-accuracy",
        "Accuracy against ground truth",
        "How many obstacle voxels are found, how many are false, and how large is the error of the distance?",
        limit_s=400.0,
    ),
    Part(
        "benchmarks.sweeps",
        "sweeps",
        "Thin things, small things and empty cells",
        "How thin may a thing be, and how many false voxels does an empty cell have?",
    ),
    Part(
        "benchmarks.right_time",
        "right-time",
        "The robot at the time of the frame",
        "How do late, jittering or rare joints affect the filter?",
    ),
    Part(
        "benchmarks.board",
        "bench-board",
        "Pose by a printed board",
        "How accurate is a camera pose from a calibration board?",
    ),
    Part(
        "benchmarks.pose_monitor",
        "bench-pose-monitor",
        "Knocked and covered cameras",
        "How soon is a knock reported, and how often is there a false alarm?",
    ),
    Part(
        "benchmarks.master",
        "bench-master",
        "The master at its limit",
        "How many updates a second does it take, compared with a bare web service?",
    ),
    Part(
        "qualification.faults",
        "faults",
        "Failures of the system",
        "Is the map right during a failure, and how soon is it complete again?",
    ),
    Part(
        "qualification.soak",
        "soak",
        "All failures at once",
        "Is any answer wrong during a long run, and does any resource grow?",
    ),
    Part(
        "qualification.source_faults",
        "source-faults",
        "Cameras that fail",
        "How soon is the failure reported, and how soon do frames flow again?",
    ),
    Part(
        "qualification.plug_and_play",
        "plug-and-play",
        "Power on and forget",
        "How long until factory-new units are live?",
    ),
    Part(
        "qualification.boot",
        "rehearsal",
        "Machines that boot",
        "How long from power-on to the first voxel?",
    ),
    Part(
        "qualification.image",
        "image-test",
        "One image, two arm64 boards",
        "Do both boot, get identities of their own and report, and how soon?",
    ),
    Part(
        "qualification.fresh_machine",
        "fresh-machine",
        "The README on a fresh machine",
        "Do both commands of the README run where there are only Python, its venv and make?",
    ),
    Part(
        "qualification.window",
        "viewer-test",
        "The operator's window",
        "How much do viewers cost the units?",
    ),
)
"""All parts in the order of the report. `make bench` runs those with a limit."""
