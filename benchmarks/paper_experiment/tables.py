# SPDX-License-Identifier: Apache-2.0
"""The paper's tables from the measurements, beside the figures that the paper states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.paper_experiment.book import (
    ONE_OCTREE,
    ONE_PROCESS,
    ONE_PROCESS_BESIDE,
    UNITS_COMPOSED,
    UNITS_RUNNING,
    Book,
)
from benchmarks.paper_experiment.composed import Parts
from benchmarks.paper_experiment.scene import CAMERAS
from benchmarks.reporting.report import Mark, Result

PAPER = "Distributed Camera Subsystem for Obstacle Detection, Sensors 2022, 22(12), 4588"

PAPER_CAMERAS = 3
"""Number of cameras in the paper's Tables 1 and 2."""

PAPER_FPS = {"424x240": 15.0, "640x480": 6.0, "1280x720": 2.0}
"""Frames per second that the paper's centralised system reached with three cameras, of 15 requested."""

PAPER_SMALL_VOXELS_S = {"424x240": 1.9, "640x480": 2.0, "1280x720": 2.9}
"""Refresh of the paper's centralised system for voxels smaller than 20 mm."""

PAPER_DISTRIBUTED_S = (0.05, 0.3)
"""Fastest and slowest refresh, over all resolutions and voxel sizes."""

PAPER_FASTER_PERCENT = (38.7, 40.1, 59.4, 71.5)
"""Gain of the paper's distributed system with one, two, three and four cameras (Equation 7)."""

PAPER_TRANSFER_MS = 12.0
"""Mean time of an update of up to 1000 voxels, there and back, four units."""

PAPER_FRAME_KBIT, PAPER_UPDATE_KBIT = 9800.0, 9.3
"""Size of a depth image of 640x480 and of a unit's update, by the paper's count."""

STATED = {
    "source": PAPER,
    "cameras": PAPER_CAMERAS,
    "centralised_fps": PAPER_FPS,
    "centralised_s_below_20_mm": PAPER_SMALL_VOXELS_S,
    "distributed_s": PAPER_DISTRIBUTED_S,
    "faster_percent_by_cameras": PAPER_FASTER_PERCENT,
    "transfer_ms": PAPER_TRANSFER_MS,
    "kbit_of_a_depth_image": PAPER_FRAME_KBIT,
    "kbit_of_an_update": PAPER_UPDATE_KBIT,
}

NOT_COMPARABLE = (
    "The paper's distributed units were Jetson Nanos (four Cortex-A57 at 1.43 GHz), its centralised system a laptop "
    "with a GTX 1070, with real cameras at 15 frames a second: its milliseconds and ours are not comparable, the "
    "ratios between contenders on one machine are.",
    "The text of the paper does not contain the cells of its Tables 1 and 2; only the figures in the"
    " text are compared with ours.",
    "Frames are simulated (rays by Embree, a D435i's faults), one person, a UR3 that moves in every "
    "frame. The joints are stored with the frames, and no joints are sent to the master meanwhile.",
)

BELOW_ZERO = (
    "Below zero the centralised way is faster: a frame costs less than bringing its voxels to a "
    "master. The comparison uses equal cores; the paper's centralised computer was the stronger one."
)

Row = tuple[str | float, ...]


def faster_percent(distributed_ms: float, centralised_ms: float) -> float:
    """Equation 7: return the gain of the distributed way in percent of the centralised time."""
    return 100.0 * (centralised_ms - distributed_ms) / centralised_ms


def by_size(book: Book, contender: str, cameras: int = PAPER_CAMERAS) -> Result:
    """Return the refresh of the whole scene by voxel size and resolution, as in Tables 1 and 2."""
    keys = [key for key in book if key.contender == contender and key.cameras == cameras]
    resolutions = list(dict.fromkeys(key.resolution for key in keys))
    rows: list[Row] = []
    for voxel_mm in sorted({key.voxel_mm for key in keys}):
        cells: list[str | float] = [voxel_mm]
        for resolution in resolutions:
            (key,) = [key for key in keys if (key.resolution, key.voxel_mm) == (resolution, voxel_mm)]
            spread = book.spread(key)
            cells += [spread.median_ms, spread.p99_ms]
        rows.append(tuple(cells))
    columns = ("voxel mm", *(name for each in resolutions for name in (f"{each} ms", f"{each} p99")))
    return Result(f"Refresh of the scene by {cameras} cameras: {contender}", columns, tuple(rows))


def by_cameras(book: Book, contenders: Sequence[str], voxel_mm: int) -> Result:
    """Return the refresh by the number of cameras, as in Figure 12."""
    rows: list[Row] = []
    for resolution in dict.fromkeys(key.resolution for key in book):
        for contender in contenders:
            values = [book.median(contender, resolution, voxel_mm, count) for count in range(1, CAMERAS + 1)]
            if not np.isnan(values).any():
                rows.append((resolution, contender, *values, values[-1] / values[0]))
    columns = ("resolution", "contender", *(f"{count} cam. ms" for count in range(1, CAMERAS + 1)), "4 to 1")
    return Result(f"Refresh of the scene by the number of cameras, {voxel_mm} mm voxels", columns, tuple(rows))


def faster(book: Book, distributed: str, centralised: Sequence[str]) -> Result:
    """Return Equation 7 by the number of cameras: the mean over all resolutions and voxel sizes that both have."""
    rows: list[Row] = []
    for count in range(1, CAMERAS + 1):
        means = []
        for contender in centralised:
            shares = [
                faster_percent(
                    book.median(distributed, key.resolution, key.voxel_mm, count), book.spread(key).median_ms
                )
                for key in book
                if (key.contender, key.cameras) == (contender, count)
            ]
            means.append(float(np.nanmean(shares)) if shares else float("nan"))
        rows.append((count, PAPER_FASTER_PERCENT[count - 1], *means))
    columns = ("cameras", "paper %", *(f"than {contender} %" for contender in centralised))
    return Result(f"How much faster (Equation 7): {distributed}", columns, tuple(rows), remarks=(BELOW_ZERO,))


def faster_by_resolution(book: Book, cameras: int = PAPER_CAMERAS) -> Result:
    """Return Equation 7 by resolution, as in Table 2: the mean over the voxel sizes that both have."""
    rows: list[Row] = []
    for resolution in dict.fromkeys(key.resolution for key in book):
        cells: list[str | float] = [resolution]
        for contender in (ONE_PROCESS, ONE_OCTREE):
            shares = [
                faster_percent(
                    book.median(UNITS_COMPOSED, resolution, key.voxel_mm, cameras), book.spread(key).median_ms
                )
                for key in book
                if (key.contender, key.resolution, key.cameras) == (contender, resolution, cameras)
            ]
            cells.append(float(np.mean(shares)) if shares else float("nan"))
        rows.append(tuple(cells))
    columns = ("resolution", f"than {ONE_PROCESS} %", f"than {ONE_OCTREE} %")
    return Result(f"How much faster (Equation 7) with {cameras} cameras: {UNITS_COMPOSED}", columns, tuple(rows))


def anatomy(parts: Sequence[Parts]) -> Result:
    """Return the parts of a composed refresh of all cameras, and the bytes of its updates."""
    rows: list[Row] = []
    for each in parts:
        unit, trip = np.array(each.unit_ms), np.array(each.trip_ms)
        rows.append(
            (
                each.resolution,
                each.voxel_mm,
                float(np.median(each.voxels)),
                float(np.median(unit.max(axis=1))),
                float(np.median(trip)),
                float(np.percentile(trip, 99)),
                float(np.median(each.waited_ms()[:, -1])),
                float(np.median(np.array(each.merge_ms)[:, -1])),
                float(np.median(np.array(each.map_ms)[:, -1])),
                float(np.mean(each.update_bytes)),
            )
        )
    columns = (
        "resolution",
        "voxel mm",
        "voxels merged",
        "slowest unit ms",
        "update ms",
        "update p99",
        "four at once, more ms",
        "merge ms",
        "GET /voxels ms",
        "bytes an update",
    )
    return Result(f"The parts of a refresh by {CAMERAS} cameras: {UNITS_COMPOSED}", columns, tuple(rows))


def beside_the_paper(book: Book, parts: Sequence[Parts]) -> Result:
    """Return the figures that the paper states beside those measured here under the same name."""
    rows: list[Row] = []
    resolutions = list(dict.fromkeys(key.resolution for key in book))
    smallest_mm = min(key.voxel_mm for key in book)
    for resolution in resolutions:
        ours = [
            book.median(each, resolution, smallest_mm, PAPER_CAMERAS) / 1e3 for each in (UNITS_COMPOSED, ONE_OCTREE)
        ]
        name = f"{resolution}, voxels under 20 mm, centralised (here: as MoveIt's updaters, {smallest_mm} mm), s"
        rows.append((name, f"{PAPER_SMALL_VOXELS_S[resolution]:g}", ours[1], ours[0]))
    for resolution in resolutions:
        slowest = _slowest_ms(book, ONE_OCTREE, resolution)
        fps = [1e3 / slowest, 1e3 / _slowest_ms(book, UNITS_COMPOSED, resolution)]
        rows.append((f"{resolution}, refreshes/s at the slowest voxel size", f"{PAPER_FPS[resolution]:g} of 15", *fps))
    distributed = [
        book.spread(key).median_ms / 1e3
        for key in book
        if (key.contender, key.cameras) == (UNITS_COMPOSED, PAPER_CAMERAS)
    ]
    low, high = PAPER_DISTRIBUTED_S
    nothing = float("nan")
    rows.append(("distributed, quickest refresh, s", f"{low:g}", nothing, min(distributed)))
    rows.append(("distributed, slowest refresh, s", f"{high:g}", nothing, max(distributed)))
    trips = float(np.mean([np.mean(each.trip_ms) for each in parts]))
    rows.append(("an update there and back, mean ms", f"{PAPER_TRANSFER_MS:g}", nothing, trips))
    sizes = [float(np.mean(each.update_bytes)) for each in parts if each.voxel_mm == 50]
    kbit = 8e-3 * sum(sizes) / len(sizes) if sizes else nothing
    rows.append(("an update of 50 mm voxels, kbit", f"{PAPER_UPDATE_KBIT:g}", nothing, kbit))
    rows.append(
        ("a depth image of 640x480, kbit (here of 16 bits)", f"{PAPER_FRAME_KBIT:g}", 640 * 480 * 16e-3, nothing)
    )
    columns = (f"{PAPER_CAMERAS} cameras", "paper", "centralised here", "distributed here")
    return Result("Beside what the paper states", columns, tuple(rows), remarks=NOT_COMPARABLE)


def running(book: Book) -> Result:
    """Return the refresh by unit processes on this machine beside that by all cameras in one process."""
    rows: list[Row] = []
    for key in book:
        if key.contender != UNITS_RUNNING:
            continue
        ours = book.spread(key)
        theirs = book.spread(key._replace(contender=ONE_PROCESS_BESIDE)).median_ms
        rows.append((key.resolution, key.voxel_mm, key.cameras, ours.median_ms, ours.p99_ms, theirs))
    columns = ("resolution", "voxel mm", "cameras", "processes ms", "p99", "one process ms")
    remark = (
        "Here the units share this machine's cores and also pay for processes and HTTP. The gain of "
        "units is that each brings a computer of its own."
    )
    return Result(f"Refresh of the scene: {UNITS_RUNNING}", columns, tuple(rows), remarks=(remark,))


def over_cameras(book: Book, contender: str, resolution: str, voxel_mm: int) -> list[tuple[float, float]]:
    """Return the refresh in milliseconds over the number of cameras."""
    return [(count, book.median(contender, resolution, voxel_mm, count)) for count in range(1, CAMERAS + 1)]


def over_sizes(book: Book, contender: str, resolution: str, cameras: int) -> list[tuple[float, float]]:
    """Return the refresh in milliseconds over the voxel size in millimetres."""
    sizes = sorted({key.voxel_mm for key in book if (key.contender, key.resolution) == (contender, resolution)})
    return [(size, book.median(contender, resolution, size, cameras)) for size in sizes]


def marks(book: Book, same: Parts) -> tuple[Mark, ...]:
    """Return the marks of the distributed way. In `same` all cameras have the same frames."""
    refresh_ms = np.median(same.refresh_ms(), axis=0)
    one, four = float(refresh_ms[0]), float(refresh_ms[-1])
    small = max(
        book.median(UNITS_COMPOSED, each, 10, CAMERAS) / book.median(UNITS_COMPOSED, each, 50, CAMERAS)
        for each in dict.fromkeys(key.resolution for key in book)
    )
    return (
        Mark(
            f"scene by four cameras in scenes by one, same frames, {same.resolution}, {same.voxel_mm} mm",
            four / one,
            at_most=1.15,
            why=more_of_four(same),
        ),
        Mark("scene by four cameras, 10 mm voxels in costs of 50 mm, at the worst resolution", small, at_most=2.0),
    )


def more_of_four(same: Parts) -> str:
    """Return a sentence on the additional time of four cameras with the same frames compared with one."""
    work_ms = np.array(same.unit_ms) + np.array(same.trip_ms)
    slowest_ms = float(np.median(work_ms.max(axis=1)) - np.median(work_ms[:, 0]))
    waited_ms = float(np.median(same.waited_ms()[:, -1]))
    merge_ms = np.median(np.array(same.merge_ms), axis=0)
    one_ms = float(np.median(same.refresh_ms()[:, 0]))
    apart = 1.0 + (slowest_ms + float(merge_ms[-1] - merge_ms[0])) / one_ms
    return (
        f"One takes {one_ms:.2f} ms; four take more by {slowest_ms:.2f} ms, for the slowest of four equal ones counts, "
        f"{waited_ms:.2f} ms, for one master answers four updates that come at the same moment, and "
        f"{merge_ms[-1] - merge_ms[0]:.2f} ms to merge them. Cameras that run freely seldom report at the same moment: "
        f"without that it would be {apart:.2f} times."
    )


def views_ratio(parts: Parts) -> tuple[float, float]:
    """Return a refresh of four cameras with their own views, in refreshes of the first or the slowest alone."""
    together, alone = np.median(parts.refresh_ms()[:, -1]), np.median(parts.alone_ms(), axis=0)
    return float(together / alone[0]), float(together / alone.max())


def _slowest_ms(book: Book, contender: str, resolution: str) -> float:
    """Return the slowest of all voxel sizes with three cameras; NaN if nothing was measured."""
    found = [
        book.spread(key).median_ms
        for key in book
        if (key.contender, key.resolution, key.cameras) == (contender, resolution, PAPER_CAMERAS)
    ]
    return max(found, default=float("nan"))
