# SPDX-License-Identifier: Apache-2.0
"""`make bench-board`: measure the error of a camera pose from a calibration board, by kind of board, stream and
distance.

The images are simulated: 1280x720, perspective, antialiased, blur of 0.6 px, noise of 2 grey values in 255. Boards are
tilted by 10 to 45 degrees and stand anywhere in the middle third of the image. The frames of one view differ only in
their noise. The command prints a table and all figures as one line of JSON; a whole run also writes
`out/results/board.json`. The exit code is 1 when a mark is missed.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.reporting.report import RESULTS, Mark, Result, line, write
from benchmarks.sweeps import runner
from edge_unit.calibration.board_layout import BoardLayout
from edge_unit.calibration.board_pose import BoardLocaliser
from shared.camera import Intrinsics
from shared.cell import Board
from shared.clock import NS_PER_MS, monotonic_ns
from shared.errors import BoardError
from shared.transforms import angle_rad, from_rotation_translation, identity, inverse, rotation_about
from simulation.cameras.board_picture import BoardPicture

FRAMES = 10
"""Frames of one view: the number that a unit takes for a calibration."""

VIEWS = 50

DISTANCES_M = (1.0, 2.0, 3.0)
TILTS_DEG = (10.0, 45.0)

MARKED = {1.0: (3.0, 0.2), 3.0: (15.0, 0.3)}
"""By distance in metres: the error in mm and degrees that 90 of 100 views must not exceed."""

STREAMS = {
    "colour": Intrinsics(1280, 720, 915.0, 915.0, 641.25, 361.75),
    "infrared": Intrinsics(1280, 720, 636.5, 636.5, 641.25, 361.75),
}


def _board(kind: str, columns: int, rows: int, square_mm: float, marker_mm: float) -> Board:
    fields = {"kind": kind, "columns": columns, "rows": rows, "square_m": square_mm / 1e3, "marker_m": marker_mm / 1e3}
    document = {"dictionary": "DICT_4X4_250", "first_marker": 0, "T_world_board": identity().tolist()}
    return Board.from_document({**fields, **document})


BOARDS = {
    "colour": (_board("grid", 5, 7, 75.0, 60.0), _board("charuco", 5, 7, 75.0, 56.0)),
    "infrared": (_board("grid", 3, 4, 125.0, 100.0), _board("charuco", 4, 5, 130.0, 100.0)),
}
"""A stream with fewer pixels per degree needs larger markers: 60 mm for colour, 100 mm for infrared."""


@dataclass(frozen=True)
class View:
    """Result of one view; NaN if no pose was found."""

    error_mm: float
    error_deg: float
    uncertainty_mm: float
    uncertainty_deg: float
    reprojection_px: float
    milliseconds: float


def views(stream: str, board: Board, distance_m: float, count: int, first: int = 0) -> list[View]:
    """Localise a camera in `count` views."""
    camera = STREAMS[stream]
    layout = BoardLayout.of(board)
    picture = BoardPicture(layout, camera)
    found = []
    for number in range(first, first + count):
        rng = np.random.default_rng((number, round(1e3 * distance_m)))
        azimuth, tilt = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(*TILTS_DEG))
        rotation = rotation_about((np.cos(azimuth), np.sin(azimuth), 0.0), tilt)
        rotation = rotation @ rotation_about((0.0, 0.0, 1.0), rng.uniform(-0.2, 0.2) * np.pi)
        middle_m = np.array((*(rng.uniform(-1.0, 1.0, 2) * (0.15, 0.08) * distance_m), distance_m))
        T_camera_board = from_rotation_translation(
            rotation, middle_m - rotation @ (*(0.5 * np.array(layout.size_m)), 0)
        )
        localiser = BoardLocaliser(board, camera)
        exposed = picture.expose(T_camera_board)
        busy_ns = 0
        for _ in range(FRAMES):
            image = picture.develop(exposed, rng)
            begun_ns = monotonic_ns()
            localiser.add(image)
            busy_ns += monotonic_ns() - begun_ns
        milliseconds = busy_ns / FRAMES / NS_PER_MS
        try:
            result = localiser.result()
        except BoardError:
            found.append(View(*(5 * (np.nan,)), milliseconds))
            continue
        off = T_camera_board @ result.T_world_camera
        shift_m = result.T_world_camera[:3, 3] - inverse(T_camera_board)[:3, 3]
        found.append(
            View(
                1e3 * float(np.linalg.norm(shift_m)),
                float(np.degrees(angle_rad(off))),
                result.uncertainty_mm,
                result.uncertainty_deg,
                result.reprojection_px,
                milliseconds,
            )
        )
    return found


def result(found: dict[tuple[str, Board, float], list[View]]) -> Result:
    """Return one row per board, stream and distance, and the marks of those distances that have one."""
    rows: list[tuple[str | float, ...]] = []
    marks = []
    for (stream, board, distance_m), each in found.items():
        name = f"{board.kind} {1e3 * board.marker_m:.0f} mm"
        # A view without a pose counts as worse than any error.
        error_mm = np.nan_to_num([view.error_mm for view in each], nan=np.inf)
        error_deg = np.nan_to_num([view.error_deg for view in each], nan=np.inf)
        posed = [view for view in each if np.isfinite(view.error_mm)]
        worst_mm, worst_deg = (_nearest(values, 90.0) for values in (error_mm, error_deg))
        within = [view.error_mm <= 2.0 * view.uncertainty_mm for view in posed]
        rows.append((
            stream, name, distance_m, f"{len(posed)}/{len(each)}",
            _nearest(error_mm, 50.0), worst_mm, _nearest(error_deg, 50.0), worst_deg,
            _median([view.uncertainty_mm for view in posed]), 100.0 * float(np.mean(within)) if within else np.nan,
            _median([view.reprojection_px for view in posed]), _median([view.milliseconds for view in each]),
        ))  # fmt: skip
        if distance_m in MARKED:
            most_mm, most_deg = MARKED[distance_m]
            where = f"{stream}, {name} markers, {distance_m:g} m: 90 % of views within,"
            marks.append(Mark(f"{where} mm", worst_mm, at_most=most_mm))
            marks.append(Mark(f"{where} degrees", worst_deg, at_most=most_deg))
    return Result(
        f"The camera's pose in the board's frame, {FRAMES} frames a view, boards tilted {TILTS_DEG[0]:g} to "
        f"{TILTS_DEG[1]:g} degrees",
        ("stream", "board", "m", "found", "median mm", "90 % mm", "median deg", "90 % deg", "told mm",
         "within 2x told %", "reprojection px", "ms a frame"),
        tuple(rows),
        tuple(marks),
    )  # fmt: skip


def _nearest(values: Sequence[float] | NDArray[np.float64], percent: float) -> float:
    """Return a percentile that is one of the values, because some values may be infinite."""
    return float(np.percentile(values, percent, method="higher"))


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all boards."""
    parser = argparse.ArgumentParser(
        prog="make bench-board", description="Measure the camera pose from a calibration board."
    )
    parser.add_argument("--views", type=int, default=VIEWS, help=f"views of each board at each distance ({VIEWS})")
    parser.add_argument("--processes", type=int, default=min(os.cpu_count() or 1, 8), help="number of processes")
    parser.add_argument("--results", type=Path, help="folder for board.json, also of a run with fewer views")
    options = parser.parse_args(arguments)
    cases = [
        (stream, board, distance_m)
        for stream, boards in BOARDS.items()
        for board in boards
        for distance_m in DISTANCES_M
    ]
    with runner(options.processes) as run:
        jobs = [partial(views, stream, board, distance_m, options.views) for stream, board, distance_m in cases]
        found = run(jobs)
    table = result(dict(zip(cases, found, strict=True)))
    print(f"{table}\n")
    document = {**table.document(), "views": options.views, "frames_a_view": FRAMES}
    document["passed"] = all(mark.met for mark in table.marks)
    if options.views >= VIEWS or options.results:
        write("board", document, options.results or RESULTS)
    print(line(document))
    return 0 if document["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
