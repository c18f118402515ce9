# SPDX-License-Identifier: Apache-2.0
"""`make bench-accuracy`: count the obstacle voxels that the filter finds, misses and invents, and measure their
distance error.

Our filter, the paper's own rule and a minimum number of points per voxel get the same frames of a D435i. Embree casts a
ray for each pixel. The results are curves over distance, size, voxel size and threshold; then follow real frames. The
command prints tables and writes `out/results/accuracy.json`. Its `curves` explain themselves, and its `remarks` list
the figures in which our filter is worse. The exit code is 1 when a mark is missed.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import real_frames
from benchmarks.ground_truth import plan, real
from benchmarks.ground_truth.curves import EVERYTHING, Collection, Curve, by_thing, tables, worse
from benchmarks.ground_truth.plan import (
    ARM,
    BASELINES,
    CONTENDERS,
    OURS,
    QUICK,
    SPECKLE,
    STAND_OFFS,
    TRIALS,
    WALL,
    Amount,
    AnyTrial,
)
from benchmarks.ground_truth.real import Judged
from benchmarks.ground_truth.rules import MinimumPoints, Paper, Place
from benchmarks.ground_truth.surface import visible_pixels_min
from benchmarks.ground_truth.things import before_wall
from benchmarks.ground_truth.trials import Tallies, Trial
from benchmarks.reporting.report import RESULTS, Mark, line, write
from benchmarks.sweeps import runner
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import SourceError
from shared.settings import FilterSettings
from simulation.cameras.depth_noise import DepthNoise

REAL = "real"
PARTS = (*TRIALS, REAL)

MARKED_FROM_M, MARKED_TO_M = 0.75, 3.0
"""Distances between which the things must be found. A nearer person does not fit into the image; beyond it, the noise
is 60 mm or more.
"""

FOUND_MIN_PERCENT, FALSE_FRAMES_MAX = 99.0, 0.5

SHOWN = {
    "distance": {"recall_percent": "found %", "recall_strict_percent": "strictly %", "false_per_1000": "false",
                 "tool_median_mm": "off mm", "tool_p99_mm": "99 % mm"},
    "voxel": {"recall_percent": "found %", "recall_strict_percent": "strictly %", "false_per_1000": "false",
              "tool_median_mm": "off mm"},
    "threshold": {"recall_percent": "found %", "false_per_1000": "false", "lost_percent": "lost %"},
    "points": {"recall_percent": "found %", "false_per_1000": "false", "lost_percent": "lost %"},
    "stand-off": {"recall_percent": "found %", "lost_percent": "lost %", "false_per_1000": "false"},
    "limit": {"recall_percent": "found %", "false_per_1000": "false"},
    "wall": {"false_per_1000": "false"},
    "quiet": {"false_per_1000": "false"},
}  # fmt: skip
"""The columns of each axis's table."""

REMARKS = (
    "All contenders get the same frames, the same expected depth of the pipeline and the same mask "
    "of the padded robot: the benchmark compares rules, not renderers.",
    "The noise model is a D435i's as measured on recorded frames, with halo, shadow, flying pixels "
    "and holes. It never loses a thin thing, as a real stereo matcher may. Only the curves that name"
    " them have wrong matches.",
)

PICTURES = (
    *(("distance", "recall_percent", thing) for thing in (EVERYTHING, "rod 10 mm", "arm 80 mm", "person")),
    ("distance", "false_per_1000", EVERYTHING),
    ("distance", "tool_median_mm", EVERYTHING),
    ("distance", "tool_p99_mm", EVERYTHING),
    ("voxel", "recall_percent", EVERYTHING),
    ("voxel", "false_per_1000", EVERYTHING),
    ("threshold", "recall_percent", EVERYTHING),
    ("threshold", "false_per_1000", SPECKLE),
    ("points", "recall_percent", EVERYTHING),
    *(("stand-off", "recall_percent", subject) for subject in STAND_OFFS),
    ("limit", "false_per_1000", ARM),
    ("wall", "false_per_1000", WALL),
)
"""Curves that the page shows: axis, metric, subject."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parts that the command line names."""
    options = _parser().parse_args(arguments)
    amount = QUICK if options.quick else Amount()
    parts = options.only or PARTS
    settings = FilterSettings()
    begun_ns = monotonic_ns()
    try:
        if REAL in parts:
            real_frames.find()
        collection, judged = run(parts, amount, settings, options.processes)
    except SourceError as error:
        print(f"make bench-accuracy: {error}", file=sys.stderr)
        return 1
    curves = collection.curves()
    _print(curves)
    marks = [*marks_of(collection, amount, parts), *(real.marks(judged, OURS) if judged else [])]
    told = [worse(curves, OURS, BASELINES), *(real.results(judged, OURS) if judged else [])]
    took_s = (monotonic_ns() - begun_ns) / NS_PER_S
    print("\n\n".join(map(str, told)), "\n")
    print("\n".join([*REMARKS, "", *map(str, marks), f"({took_s:.0f} s)"]))
    document = document_of(curves, amount, settings) | {
        "results": [each.document() for each in told],
        "marks": [mark.document() for mark in marks],
        "passed": all(mark.met for mark in marks),
        "quick": options.quick,
        "took_s": round(took_s, 1),
    }
    if options.results or not (options.quick or options.only):
        write("accuracy", document, options.results or RESULTS)
    print(line({key: document[key] for key in ("passed", "marks", "took_s")}))
    return 0 if document["passed"] else 1


def run(
    parts: Sequence[str], amount: Amount, settings: FilterSettings, processes: int
) -> tuple[Collection, list[Judged]]:
    """Run all trials of the `parts`, and the real frames if `parts` names them."""
    trials: list[AnyTrial] = []
    # The longest trials run first, so that no process works alone at the end.
    for part in sorted(parts, key=lambda part: part != "size"):
        if part != REAL:
            trials += TRIALS[part](amount, settings)
    fixed: real.Fixed = {plan.PAPER: Paper(), plan.POINTS: MinimumPoints()}
    jobs: list[Callable[[], Any]] = [trial.run for trial in trials]
    if REAL in parts:
        jobs.insert(0, partial(real.watch, OURS, fixed, settings, amount.held_out))
    print(f"{len(jobs)} trials by {processes} processes ...", flush=True)
    with runner(processes) as do:
        found = do(jobs)
    judged: list[Judged] = found.pop(0) if REAL in parts else []
    collection = Collection()
    for trial, tallies in zip(trials, found, strict=True):
        counted: Tallies = tallies
        collection.add(trial.subject, counted, in_sum=isinstance(trial, Trial) and trial.subject == trial.thing)
    return collection, judged


def marks_of(collection: Collection, amount: Amount, parts: Sequence[str]) -> list[Mark]:
    """Return the marks of our filter on the stage."""
    marks = []
    if "distance" in parts:
        held = [each for each in amount.distances_m if MARKED_FROM_M <= each <= MARKED_TO_M]
        span = f"{MARKED_FROM_M:g} to {MARKED_TO_M:g} m"
        for thing in amount.things:
            at = [collection.tally("distance", thing, OURS, distance_m) for distance_m in held]
            found = min(100.0 * tally.found / tally.visible for tally in at)
            lost = sum(tally.lost_frames for tally in at)
            marks.append(Mark(f"{thing}, {span}: visible voxels found, %, worst", found, at_least=FOUND_MIN_PERCENT))
            marks.append(Mark(f"{thing}, {span}: frames that lose it", lost, at_most=0))
    if "size" in parts:
        speckle = collection.tally("threshold", plan.SPECKLE, OURS, FilterSettings().occupancy_threshold)
        marks.append(Mark("wrong matches that are reported, voxels", speckle.false, at_most=0))
    if "wall" in parts:
        walls = [each for each in amount.walls_m if each <= MARKED_TO_M]
        false = sum(collection.tally("wall", plan.WALL, OURS, wall_m).false for wall_m in walls)
        marks.append(Mark(f"an empty wall to {MARKED_TO_M:g} m: false voxels", false, at_most=0))
    if "quiet" in parts:
        moving = collection.tally("quiet", plan.QUIET, OURS)
        share = 100.0 * moving.false_frames / moving.frames
        marks.append(Mark("a robot that moves alone: frames with false voxels, %", share, at_most=FALSE_FRAMES_MAX))
    return marks


def document_of(curves: list[Curve], amount: Amount, settings: FilterSettings) -> dict[str, Any]:
    """Return the measured figures and the method as plain values. `curves` are for plots; `figures` has all of them."""
    shown = {(curve.axis.key, curve.metric.key, curve.subject): curve for curve in curves}
    pictures = [shown[name].picture for name in PICTURES if name in shown]
    if any(curve.axis.key == "distance" for curve in curves):
        pictures += [
            by_thing(curves, "distance", "recall_strict_percent", OURS, amount.things),
            by_thing(curves, "distance", "recall_percent", plan.PAPER, amount.things),
        ]
    stage = before_wall(1.0, 1.0, DepthNoise(), 0)
    place = Place(stage.intrinsics, stage.T_world_camera, stage.cell)
    size_m = settings.voxel_size_m
    return {
        "contenders": CONTENDERS,
        "camera": {"model": "D435i", **stage.intrinsics.model_dump(), "noise": DepthNoise().model_dump()},
        "settings": settings.model_dump(),
        "definitions": {
            "visible voxel": "shows at least N pixels of the true surface to a perfect camera: a tenth of those of a "
            "full voxel that faces it",
            "N by distance (m), 50 mm voxels": {
                f"{distance_m:g}": visible_pixels_min(place, size_m, distance_m) for distance_m in amount.distances_m
            },
            f"N by voxel (mm), at {plan.NEAR_M:g} m": {
                f"{1e3 * each_m:g}": visible_pixels_min(place, each_m, plan.NEAR_M) for each_m in amount.voxels_m
            },
            "found within a voxel": "it or one of its 26 neighbours is reported",
            "found strictly": "it is reported itself",
            "lost": "no visible voxel of the frame is found within a voxel",
            "false voxel": "its middle is farther from the true visible surface than its diagonal and three standard "
            "deviations of depth",
            "error of distance": "of the nearest reported voxel, as a cube, less that of the nearest point of the true "
            "visible surface; below 0 is too near; from the camera, or from a tool 0.3 m beside the thing; null when "
            "nothing was reported in so many frames",
        },
        "remarks": list(REMARKS),
        "curves": [picture.document() for picture in pictures],
        "figures": [curve.document() for curve in curves],
    }


def _print(curves: list[Curve]) -> None:
    for axis, metrics in SHOWN.items():
        if any(curve.axis.key == axis for curve in curves):
            print("\n".join([*tables(curves, axis, metrics, tuple(CONTENDERS)), ""]))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make bench-accuracy", description="Compare the filter with ground truth.")
    parser.add_argument("--quick", action="store_true", help="a small amount of everything, in some seconds")
    parser.add_argument("--only", nargs="+", choices=PARTS, help="only these parts")
    parser.add_argument("--processes", type=int, default=min(os.cpu_count() or 1, 8), help="number of processes")
    parser.add_argument("--results", type=Path, help="folder for accuracy.json, also of a partial run")
    return parser


if __name__ == "__main__":
    sys.exit(main())
