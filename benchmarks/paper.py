# SPDX-License-Identifier: Apache-2.0
"""`make bench-paper`: the experiment of the paper that the method comes from, on this machine.

It measures the refresh of the scene by resolution, voxel size (10 to 100 mm) and number of cameras (one to four),
distributed and centralised. All contenders take turns on the same frames. Every map is compared with the map that the
frames must give.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.paper_experiment import composed, master, running, tables
from benchmarks.paper_experiment.book import (
    CONTENDERS,
    ONE_OCTREE,
    ONE_PROCESS,
    ONE_PROCESS_BESIDE,
    UNITS_COMPOSED,
    UNITS_RUNNING,
    UNITS_SAME_FRAMES,
    Book,
    in_mm,
)
from benchmarks.paper_experiment.scene import Views, views, write_cell
from benchmarks.reporting.report import RESULTS, Curves, Result, line, write
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError
from simulation.fleet.fleet import MASTER_PREFIX
from simulation.fleet.processes import Processes

VOXEL_M = 0.02
"""Voxel size of the tables that have only one."""


@dataclass(frozen=True)
class Amount:
    """Number of frames, rounds and sizes of a run."""

    resolutions: tuple[tuple[int, int], ...] = ((424, 240), (640, 480), (1280, 720))
    sizes_m: tuple[float, ...] = tuple(mm / 1e3 for mm in range(10, 101, 10))
    frames: int = 4
    rounds: int = 20
    octree_rounds: Mapping[float, int] = field(default_factory=lambda: dict.fromkeys((0.01, 0.02, 0.05, 0.1), 3))
    running_sizes_m: tuple[float, ...] = (0.01, 0.02, 0.05)
    running_rounds: int = 12
    same_rounds: int = 60


QUICK = Amount(
    resolutions=((424, 240),),
    sizes_m=(0.01, 0.02, 0.05),
    frames=2,
    rounds=4,
    octree_rounds={0.02: 1, 0.05: 1},
    running_sizes_m=(0.02,),
    running_rounds=3,
    same_rounds=8,
)


@dataclass(frozen=True, eq=False)
class Found:
    """All measurements. In the fields named `same`, all cameras have the same frames."""

    book: Book
    parts: list[composed.Parts]
    same_book: Book
    same_parts: composed.Parts


async def measure(amount: Amount) -> Found:
    """Measure everything."""
    book, same = Book(), Book()
    parts: list[composed.Parts] = []
    cores = sorted(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory(prefix="cellwatch-paper-") as scratch, _timed("all of it"):
        folder = Path(scratch)
        with _timed("frames rendered"):
            seen = [views(*size, amount.frames) for size in amount.resolutions]
        write_cell(seen[0].cell, folder / "cell.yaml")
        async with Processes(folder / "logs", without=(MASTER_PREFIX,)) as processes:
            site = await master.start(processes, folder, folder / "cell.yaml")
            site.pin({cores[-1]})
            os.sched_setaffinity(0, {cores[0]})
            try:
                for each in seen:
                    with _timed(f"{each.name}, composed and centralised"):
                        bench = composed.Bench(site, each, UNITS_COMPOSED, book)
                        parts += await bench.run(amount.sizes_m, amount.rounds, amount.octree_rounds)
                with _timed("all cameras with the same frames"):
                    bench = composed.Bench(site, seen[-1].of_one(0), UNITS_SAME_FRAMES, same)
                    (same_parts,) = await bench.run((VOXEL_M,), amount.same_rounds, {})
            finally:
                os.sched_setaffinity(0, cores)
            site.pin(set(cores))
            with _timed("units as processes"):
                await _run_units(site, seen, folder, amount, book)
    return Found(book, parts, same, same_parts)


async def _run_units(site: master.Site, seen: Sequence[Views], folder: Path, amount: Amount, book: Book) -> None:
    with running.running(site) as units:
        for each in seen:
            bench = running.Bench(site, units, each, folder, book)
            await bench.run(amount.running_sizes_m, amount.running_rounds)


def results_of(found: Found) -> dict[str, Result]:
    """Return the tables by name."""
    book, parts = found.book, found.parts
    voxel_mm = in_mm(VOXEL_M)
    largest = parts[-1].resolution
    (default,) = [each for each in parts if (each.resolution, each.voxel_mm) == (largest, voxel_mm)]
    first, slowest = tables.views_ratio(default)
    by_cameras = tables.by_cameras(book, (UNITS_COMPOSED, ONE_PROCESS, ONE_OCTREE), voxel_mm)
    figure = Result(
        by_cameras.title,
        by_cameras.columns,
        by_cameras.rows,
        tables.marks(book, found.same_parts),
        (
            f"With different views, {largest}, {voxel_mm} mm: four cameras take {first:.2f} refreshes of the first "
            f"alone, {slowest:.2f} of the slowest alone.",
            f"With the same frames: {tables.more_of_four(found.same_parts)}",
        ),
    )
    return {
        "contenders": Result("What is compared", ("contender", "what it does"), tuple(CONTENDERS.items())),
        "table_2_distributed": tables.by_size(book, UNITS_COMPOSED),
        "table_1_centralised_same_filter": tables.by_size(book, ONE_PROCESS),
        "table_1_centralised_octree": tables.by_size(book, ONE_OCTREE),
        "table_2_faster": tables.faster_by_resolution(book),
        "figure_12_by_cameras": figure,
        "figure_12_faster": tables.faster(book, UNITS_COMPOSED, (ONE_PROCESS, ONE_OCTREE)),
        "running": tables.running(book),
        "running_faster": tables.faster(book, UNITS_RUNNING, (ONE_PROCESS_BESIDE,)),
        "anatomy": tables.anatomy(parts),
        "beside_the_paper": tables.beside_the_paper(book, parts),
    }


def curves_of(book: Book) -> dict[str, Curves]:
    """Return the plots by name: the largest resolution, and every contender that was measured there."""
    contenders, resolution = (UNITS_COMPOSED, ONE_PROCESS, ONE_OCTREE), [key.resolution for key in book][-1]
    cameras = tables.PAPER_CAMERAS
    return {
        "by_cameras": Curves(
            f"Refresh of the scene by the number of cameras, {resolution}, {in_mm(VOXEL_M)} mm voxels",
            "cameras",
            "refresh, ms",
            {name: tables.over_cameras(book, name, resolution, in_mm(VOXEL_M)) for name in contenders},
            "y",
        ),
        "by_voxel_size": Curves(
            f"Refresh of the scene by {cameras} cameras, {resolution}",
            "voxel, mm",
            "refresh, ms",
            {name: tables.over_sizes(book, name, resolution, cameras) for name in contenders},
            "y",
        ),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the tables, and all of it as one line of JSON. Exit code 1 when a mark is missed."""
    options = _parser().parse_args(arguments)
    try:
        found = asyncio.run(measure(QUICK if options.quick else Amount()))
    except (CellwatchError, ImportError) as error:
        print(f"make bench-paper: {error}", file=sys.stderr)
        return 1
    results = results_of(found)
    print("\n".join(f"\n{result}" for result in results.values()))
    same_rows = [row for row in found.same_book.rows() if row["contender"] == UNITS_SAME_FRAMES]
    document: dict[str, Any] = {
        **{name: result.document() for name, result in results.items()},
        **{name: curves.document() for name, curves in curves_of(found.book).items()},
        "stated_by_the_paper": tables.STATED,
        "measurements": [*found.book.rows(), *same_rows],
        "passed": all(mark.met for result in results.values() for mark in result.marks),
        "quick": options.quick,
    }
    if options.results or not options.quick:
        write("paper", document, options.results or RESULTS)
    print(line(document))
    return 0 if document["passed"] else 1


@contextmanager
def _timed(what: str) -> Iterator[None]:
    """Print the duration of the block when it is done."""
    began_ns = monotonic_ns()
    yield
    print(f"{what}: {(monotonic_ns() - began_ns) / NS_PER_S:.0f} s", file=sys.stderr, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make bench-paper", description="Run the paper's experiment on this machine.")
    parser.add_argument("--quick", action="store_true", help="a small amount of everything, within a minute")
    parser.add_argument("--results", type=Path, metavar="DIR", help="folder for paper.json, also of a quick run")
    return parser


if __name__ == "__main__":
    sys.exit(main())
