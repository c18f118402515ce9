# SPDX-License-Identifier: Apache-2.0
"""`make sweeps`: measure the limits of the filter at its default settings, with cameras that have a D435i's faults.

Embree casts the rays, so a bug of the filter's own rasterizer cannot hide in both. The command prints a table for each
question and, at the end, all figures as one line of JSON; a whole run also writes `out/results/sweeps.json`. The exit
code is 1 when a mark is missed.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.reporting.report import RESULTS, Result, line, write
from benchmarks.sweep_scenes import quiet, shapes, thickness, walkers
from shared.camera import Intrinsics
from shared.clock import NS_PER_S, monotonic_ns
from shared.settings import FilterSettings
from simulation.cameras.camera import D435I_FOCAL_PX, d435i_intrinsics

SWEEPS = ("thickness", "curve", "shapes", "quiet", "walkers")

CURVE_DISTANCES_M = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0)
QUICK_DISTANCES_M = (1.0, 2.0)

ROD_TILTS_DEG = (shapes.ROD_TILT_MAX_DEG, 90.0)

PART_FRAMES = 100
"""Frames per job of a process: enough to amortise a cell and a camera, few enough to balance the load."""

Job = Callable[[], Any]
Run = Callable[[Sequence[Job]], list[Any]]


@dataclass(frozen=True)
class Amount:
    """Number of frames and cases of a run."""

    boxes: int = 400
    curve_boxes: int = 100
    curve_distances_m: tuple[float, ...] = CURVE_DISTANCES_M
    plate_step_m: float = 0.001
    rods: int = 300
    speckles: int = 300
    frames: int = 1000
    learned_too: bool = True
    moments: int = 150
    people: tuple[int, ...] = (1, 2)
    intrinsics: Intrinsics = field(default_factory=d435i_intrinsics)


def quick(frames: int = 10, intrinsics: Intrinsics | None = None) -> Amount:
    """Return a small amount of everything, for tests."""
    return Amount(
        boxes=100,
        curve_boxes=20,
        curve_distances_m=QUICK_DISTANCES_M,
        plate_step_m=0.01,
        rods=100,
        speckles=60,
        frames=frames,
        moments=4,
        people=(1,),
        intrinsics=intrinsics or d435i_intrinsics(),
    )


def thickness_at_the_marks(amount: Amount, settings: FilterSettings, run: Run) -> Result:
    """Test boxes of the heights that must be reported."""
    return thickness.at_the_marks(run([
        partial(thickness.trial, distance_m, height_m, cad, amount.boxes, settings)
        for distance_m, height_m in thickness.MARKED
        for cad in (True, False)
    ]))  # fmt: skip


def thickness_curve(amount: Amount, settings: FilterSettings, run: Run) -> Result:
    """Measure the thinnest box over distance."""
    points = run([
        partial(thickness.point, distance_m, amount.curve_boxes, settings) for distance_m in amount.curve_distances_m
    ])  # fmt: skip
    return thickness.curve(points, amount.curve_boxes)


def plates_rods_speckle(amount: Amount, settings: FilterSettings, run: Run) -> Result:
    """Test things that must not be lost between voxels, and speckle that must be."""
    jobs: list[Job] = []
    for camera in shapes.CAMERAS:
        for distance_m in shapes.PLATE_DISTANCES_M:
            jobs.append(partial(shapes.plates, camera, distance_m, amount.plate_step_m, settings))
        for voxel_m in shapes.VOXELS_M:
            for tilt_deg in ROD_TILTS_DEG:
                jobs.append(partial(shapes.rods, camera, voxel_m, tilt_deg, amount.rods, settings))
    jobs += [partial(shapes.speckle, voxel_m, amount.speckles, settings) for voxel_m in shapes.VOXELS_M]
    return shapes.result(run(jobs))


def quiet_cell(amount: Amount, settings: FilterSettings, run: Run) -> Result:
    """Test the cell with only the moving robot."""
    parts = quiet.parts(amount.frames, PART_FRAMES, amount.learned_too)
    found = run([partial(quiet.watch, part, amount.intrinsics, settings) for part in parts])
    return quiet.result(found, amount.intrinsics)


def walking_people(amount: Amount, settings: FilterSettings, run: Run) -> Result:
    """Test people beside the robot."""
    parts = [part for people in amount.people for part in walkers.parts(people, amount.moments, PART_FRAMES)]
    found = run([partial(walkers.watch, part, amount.intrinsics, settings) for part in parts])
    return walkers.result(found, amount.intrinsics)


_SWEEPS: dict[str, Callable[[Amount, FilterSettings, Run], Result]] = dict(
    zip(SWEEPS, (thickness_at_the_marks, thickness_curve, plates_rods_speckle, quiet_cell, walking_people), strict=True)
)


def sweep(names: Sequence[str], amount: Amount, settings: FilterSettings, run: Run) -> Iterator[tuple[str, Result]]:
    """Run the sweeps of these names, one after the other."""
    for name in names:
        yield name, _SWEEPS[name](amount, settings, run)


@contextmanager
def runner(processes: int) -> Iterator[Run]:
    """Run jobs, in their order, in that many processes; in this one if it is 1."""
    if processes <= 1:
        yield lambda jobs: [job() for job in jobs]
        return
    # Spawned, because a fork would copy the threads' locks but not the threads.
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield lambda jobs: [future.result() for future in [pool.submit(job) for job in jobs]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sweeps that the command line names."""
    options = _parser().parse_args(arguments)
    width, height = options.resolution
    amount = (
        quick(options.frames or 10, d435i_intrinsics(width, height))
        if options.quick
        else Amount(frames=options.frames or Amount.frames, intrinsics=d435i_intrinsics(width, height))
    )
    settings = FilterSettings()
    names = options.only or SWEEPS
    document: dict[str, Any] = {"settings": settings.model_dump(), "quick": options.quick}
    met = True
    with runner(options.processes) as run:
        begun_ns = monotonic_ns()
        for name, result in sweep(names, amount, settings, run):
            seconds = (monotonic_ns() - begun_ns) / NS_PER_S
            print(f"{result}\n  ({seconds:.0f} s)\n", flush=True)
            document[name] = result.document()
            met = met and all(mark.met for mark in result.marks)
            begun_ns = monotonic_ns()
    document["passed"] = met
    whole = not options.quick and not options.only
    if whole or options.results:
        write("sweeps", document, options.results or RESULTS)
    print(line(document))
    return 0 if met else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make sweeps", description="Measure the limits of the filter.")
    parser.add_argument("--quick", action="store_true", help="a small amount of everything, in half a minute")
    parser.add_argument("--only", nargs="+", choices=SWEEPS, help="only these sweeps")
    parser.add_argument("--frames", type=int, help="frames of each camera in the quiet cell (1000, quick 10)")
    parser.add_argument(
        "--resolution", type=_resolution, default=(848, 480), help="of the cameras in the cell, as in 424x240 (848x480)"
    )
    parser.add_argument("--processes", type=int, default=min(os.cpu_count() or 1, 8), help="number of processes")
    parser.add_argument("--results", type=Path, help="folder for sweeps.json, also of a partial run")
    return parser


def _resolution(text: str) -> tuple[int, int]:
    known = {f"{width}x{height}": (width, height) for width, height in D435I_FOCAL_PX}
    if text not in known:
        raise argparse.ArgumentTypeError(f"expected one of {', '.join(known)}, got {text}")
    return known[text]


if __name__ == "__main__":
    sys.exit(main())
