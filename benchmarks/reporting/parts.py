# SPDX-License-Identifier: Apache-2.0
"""What can be measured: each part's command, how long it may take, and the question that it answers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Part:
    """One module that leaves `out/results/NAME.json`."""

    name: str
    """Of the module, too."""

    target: str
    """Of `make`, by which it runs alone."""

    title: str
    asks: str
    limit_s: float | None = None
    """A part of `make bench` is ended after it; None: it runs only by itself."""

    arguments: tuple[str, ...] = ()
    """With which `make bench` runs it."""

    package: str = "benchmarks"

    @property
    def runs(self) -> str:
        """The module, for `python -m`."""
        return f"{self.package}.{self.name}"


PARTS = (
    Part(
        "pipeline",
        "bench-pipeline",
        "What a frame costs",
        "How long does one core need from depth and joints to voxels, and how long do others for the same?",
        limit_s=300.0,
    ),
    Part(
        "scale",
        "bench-scale",
        "How many units one master carries",
        "What do more units cost, what is the age of the map that a robot reads, and where does it bend?",
        limit_s=400.0,
    ),
    Part(
        "latency",
        "bench-latency",
        "From a frame to a robot's map",
        "Where do the milliseconds go from the capture of a frame to the map that a robot has?",
        limit_s=240.0,
    ),
    Part(
        "paper",
        "bench-paper",
        "The paper's experiment",
        "How long until the map holds what one to four cameras see: with a unit at each, or in one computer?",
        limit_s=480.0,
    ),
    Part(
        "real",
        "real",
        "Real frames of a real robot",
        "How much of the known robot leaks into the map, and how much of an unknown one is missed?",
        limit_s=200.0,
    ),
    Part(
        "accuracy",
        "bench-accuracy",
        "Accuracy against ground truth",
        "How much of what stands before a camera is found, how much that does not, and how far off is the nearest?",
        limit_s=400.0,
    ),
    Part("sweeps", "sweeps", "Thin, small and silent things", "How thin may a thing be, how still is a still cell?"),
    Part("right_time", "right-time", "The robot where it was", "What do late, jittering or rare joints cost?"),
    Part("board", "bench-board", "Pose by a printed board", "How exactly is a camera's pose found?"),
    Part(
        "pose_monitor",
        "bench-pose-monitor",
        "Knocked and covered cameras",
        "How soon is it told, and how often wrongly?",
    ),
    Part("master", "bench-master", "The master at its limit", "How many updates a second, beside a bare web service?"),
    Part(
        "faults",
        "faults",
        "Things that fail",
        "What does the map say meanwhile, and how soon is it right again?",
        package="qualification",
    ),
    Part(
        "soak",
        "soak",
        "All of them at once",
        "For as long as is wished: is any answer wrong, does anything grow?",
        package="qualification",
    ),
    Part(
        "source_faults",
        "source-faults",
        "Cameras that fail",
        "How soon is it told, and when do frames flow again?",
        package="qualification",
    ),
    Part(
        "plug_and_play",
        "plug-and-play",
        "Power on and forget",
        "How long until units that know nothing are live?",
        package="qualification",
    ),
    Part(
        "boot", "rehearsal", "Machines that boot", "How long from power-on to the first voxel?", package="qualification"
    ),
    Part(
        "image",
        "image-test",
        "One image, two arm64 boards",
        "Do they boot, differ and report, and how soon?",
        package="qualification",
    ),
    Part(
        "window",
        "viewer-test",
        "The operator's window",
        "What do those who look cost the units?",
        package="qualification",
    ),
)
"""In the order of the report. Those with a limit are what `make bench` runs."""
