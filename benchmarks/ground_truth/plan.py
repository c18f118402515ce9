# SPDX-License-Identifier: Apache-2.0
"""Contenders, scenes and numbers of frames: the trials of every curve."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from benchmarks.ground_truth.curves import CEILING
from benchmarks.ground_truth.rules import (
    ANY_PIXEL,
    LIMIT_M,
    PAPER_THRESHOLD,
    POINTS_MIN,
    MinimumPoints,
    Ours,
    Paper,
    Rule,
)
from benchmarks.ground_truth.things import CYLINDERS, THINGS
from benchmarks.ground_truth.trials import Entry, QuietTrial, Trial
from benchmarks.real_frames import EMPTY_FRAMES
from benchmarks.sweep_scenes.quiet import CAMERAS
from shared.settings import FilterSettings

NEAR_M = 1.5
"""Distance of the things while voxel size and threshold vary."""

BEHIND_M = 1.0
"""Distance of the wall behind the things: beyond every margin."""

LIMIT_AT_M = 2.5
"""Distance of the arm while fixed limits vary: far enough for noise to matter."""

ARM = "arm 80 mm"
STAND_OFFS = {f"{ARM} before a wall at {distance_m:g} m": distance_m for distance_m in (1.0, 2.5)}

BLOBS = 10
SPECKLE = f"{BLOBS} wrong matches of up to 20 pixels a frame"
WALL = "an empty wall"
QUIET = "the demo cell, its robot moving alone"
WALL_BOX_M = 0.5
"""Distance from an empty wall to the cell's centre, towards the camera."""

OURS, PAPER, POINTS, TUNED = "ours", "paper", "minimum points", "minimum points, tuned"
BASELINES = (PAPER, POINTS, TUNED)

TUNED_POINTS = 50
"""Number that gives no false voxels at `NEAR_M` with a wall 1 m behind, and loses nothing."""
CONTENDERS = {
    OURS: "the pipeline at its defaults: margins that grow with distance, the points of 27 voxels, the pinhole's count",
    PAPER: f"Algorithms 1, 6 and 7 as written: a fixed limit of {1e3 * LIMIT_M:.0f} mm before what is known, each "
    f"voxel by itself against {PAPER_THRESHOLD:g} of the angular count",
    POINTS: f"as STVL does: the same fixed limit, then at least {POINTS_MIN} points a voxel (its own default is 1)",
    TUNED: f"the same with {TUNED_POINTS} points a voxel, which is best for this very stage at {NEAR_M:g} m",
    CEILING: "no rule but a ceiling: every voxel into which one pixel was measured, half a metre before the wall",
}


@dataclass(frozen=True)
class Amount:
    """Number of frames, places and processes of a run."""

    frames: int = 50
    quiet_frames: int = 40
    quiet_cameras: int = CAMERAS
    things: tuple[str, ...] = THINGS
    distances_m: tuple[float, ...] = (0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
    voxels_m: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1)
    thresholds: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.2)
    points: tuple[int, ...] = (1, 2, 5, 10, 20, 50, 100, 200)
    stand_offs_m: tuple[float, ...] = (0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4)
    limits_m: tuple[float, ...] = (0.03, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
    walls_m: tuple[float, ...] = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0)
    held_out: int = len(EMPTY_FRAMES)
    """Number of empty real frames that are judged by a background model of the other empty frames."""


QUICK = Amount(
    frames=2, quiet_frames=2, quiet_cameras=1, things=("rod 20 mm", ARM), distances_m=(1.0, 3.0), voxels_m=(0.02, 0.05),
    thresholds=(0.3, 0.6), points=(1, 5), stand_offs_m=(0.1, 0.3), limits_m=(0.05, 0.3), walls_m=(1.5,), held_out=0,
)  # fmt: skip
"""A small amount of everything, for tests."""

AnyTrial = Trial | QuietTrial


def rules(settings: FilterSettings, ceiling: bool = True) -> dict[str, Rule]:
    """Return the contenders at their defaults, by name."""
    compared: dict[str, Rule] = {OURS: Ours(settings), PAPER: Paper(), POINTS: MinimumPoints()}
    compared[TUNED] = MinimumPoints(points=TUNED_POINTS)
    return compared | ({CEILING: ANY_PIXEL} if ceiling else {})


def _seed(subject: str, x: float) -> int:
    """Return a seed that differs between trials and is the same in every run."""
    return zlib.crc32(f"{subject} {x:g}".encode())


def over_distance(amount: Amount, settings: FilterSettings) -> Iterator[Trial]:
    """Every thing at every distance."""
    for thing in amount.things:
        for distance_m in amount.distances_m:
            entries = tuple(Entry("distance", name, distance_m, rule) for name, rule in rules(settings).items())
            yield Trial(thing, thing, distance_m, BEHIND_M, amount.frames, entries, seed=_seed(thing, distance_m))


def over_size(amount: Amount, settings: FilterSettings) -> Iterator[Trial]:
    """Voxel sizes and thresholds on the same frames of each thing, and thresholds with wrong matches."""
    sizes = [
        Entry("voxel", name, 1e3 * size_m, rule, size_m)
        for size_m in amount.voxels_m
        for name, rule in rules(settings).items()
    ]
    thresholds = [
        Entry("threshold", name, share, rule)
        for share in amount.thresholds
        for name, rule in (
            (OURS, Ours(settings.model_copy(update={"occupancy_threshold": share}))),
            (PAPER, Paper(threshold=share)),
        )
    ]
    thresholds += [Entry("points", POINTS, number, MinimumPoints(points=number)) for number in amount.points]
    thresholds += [Entry("points", OURS, number, Ours(settings)) for number in amount.points[:: len(amount.points) - 1]]
    for thing in amount.things:
        seed = _seed(thing, 0.0)
        yield Trial(thing, thing, NEAR_M, BEHIND_M, amount.frames, (*sizes, *thresholds), seed)
    yield Trial(
        SPECKLE, None, NEAR_M, BEHIND_M, amount.frames, tuple(thresholds), _seed(SPECKLE, 0.0), blobs=BLOBS
    )  # fmt: skip


def over_stand_off(amount: Amount, settings: FilterSettings) -> Iterator[Trial]:
    """An arm at decreasing distances from the wall."""
    radius_m = CYLINDERS[ARM][0]
    for subject, distance_m in STAND_OFFS.items():
        for front_m in amount.stand_offs_m:
            entries = tuple(
                Entry("stand-off", name, 1e3 * front_m, rule) for name, rule in rules(settings, False).items()
            )
            middle_m, seed = distance_m - front_m + radius_m, _seed(subject, front_m)
            yield Trial(subject, ARM, middle_m, front_m - radius_m, amount.frames, entries, seed, tilt_max_rad=0.0)


def over_limit(amount: Amount, settings: FilterSettings) -> Iterator[Trial]:
    """Limits of the rules with a fixed one. Ours computes its own limit, and is drawn at both ends."""
    entries = [
        Entry("limit", name, 1e3 * limit_m, rule)
        for limit_m in amount.limits_m
        for name, rule in ((PAPER, Paper(limit_m)), (POINTS, MinimumPoints(limit_m)))
    ]
    ends = amount.limits_m[:: len(amount.limits_m) - 1]
    entries += [Entry("limit", OURS, 1e3 * limit_m, Ours(settings)) for limit_m in ends]
    yield Trial(ARM, ARM, LIMIT_AT_M, BEHIND_M, amount.frames, tuple(entries), _seed(ARM, -1.0))


def over_wall(amount: Amount, settings: FilterSettings) -> Iterator[Trial]:
    """A wall in CAD, square to the camera, and nothing else: every reported voxel is false."""
    for wall_m in amount.walls_m:
        entries = tuple(Entry("wall", name, wall_m, rule) for name, rule in rules(settings, False).items())
        distance_m, seed = wall_m - WALL_BOX_M, _seed(WALL, wall_m)
        yield Trial(WALL, None, distance_m, WALL_BOX_M, amount.frames, entries, seed)


def over_cameras(amount: Amount, settings: FilterSettings) -> Iterator[QuietTrial]:
    """The demo cell with only its robot."""
    for camera in range(amount.quiet_cameras):
        entries = tuple(Entry("quiet", name, camera, rule) for name, rule in rules(settings, False).items())
        yield QuietTrial(QUIET, camera, amount.quiet_frames, entries)


TRIALS: dict[str, Callable[[Amount, FilterSettings], Iterator[AnyTrial]]] = {
    "distance": over_distance,
    "size": over_size,
    "stand-off": over_stand_off,
    "limit": over_limit,
    "wall": over_wall,
    "quiet": over_cameras,
}
