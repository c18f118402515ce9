# SPDX-License-Identifier: Apache-2.0
"""Thinnest thing on a table that is not lost in the table's margin.

A box of 10 x 10 cm lies at another place and in another orientation in each frame. The table fills the image of a
camera straight above. The table is in CAD, or learned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from benchmarks.reporting.report import Mark, Result
from benchmarks.sweep_scenes.stage import above_table, reported_at
from edge_unit.pipeline import Voxels
from shared.meshes import TriangleMesh, box_mesh
from shared.settings import FilterSettings
from shared.transforms import from_xyz_rpy
from simulation.cameras.depth_noise import DepthNoise
from simulation.world.scene import Body, Owner

SIDE_M = 0.10
"""Side of a hand, or of a forgotten tool."""

PLACES_M = 0.25
"""Largest distance of a box from the optical axis: inside the image at half a metre."""

MARKED = ((1.0, 0.070), (2.0, 0.130))
"""Distance of the table, and height of a box that must be reported there."""

REPORTED_SHARE = 0.99
EMPTY_SHARE_MAX = 0.005

STEP_M = 0.005
"""Step between the heights."""

HIGHEST_M, CLEARANCE_M = 0.6, 0.25
"""The highest box, and its smallest distance from the camera: nearer than 0.2 m nothing is measured."""

LEARNED_FRAMES = 60
"""Two seconds of the empty table."""

SHIFTS = 5
"""Number of heights of the lattice's origin relative to the table's top."""


class Trial:
    """Boxes on a table at one distance, with one filter."""

    def __init__(self, distance_m: float, cad: bool, settings: FilterSettings, seed: int) -> None:
        self._stage = above_table(distance_m, DepthNoise(), seed)
        known = self._stage.cell if cad else replace(self._stage.cell, static=())
        shifts_m = [(0.0, 0.0, settings.voxel_size_m * k / SHIFTS) for k in range(SHIFTS)]
        cells = [replace(known, box_min_m=known.box_min_m - shift_m) for shift_m in shifts_m]
        self._pipelines = [self._stage.pipeline(settings, cell) for cell in cells]
        self._highest_m = min(HIGHEST_M, distance_m - CLEARANCE_M)
        self._seed = seed
        if not cad:
            reference = self._pipelines[0].learn((self._stage.frame().depth, None) for _ in range(LEARNED_FRAMES))
            for pipeline in self._pipelines:
                pipeline.use(reference)

    def reported_share(self, height_m: float, frames: int) -> float:
        """Return the share of the frames in which a box of `height_m` is reported."""
        rng = np.random.default_rng((self._seed, round(height_m * 1e4)))
        mesh = _box(height_m)
        found = 0
        for i in range(frames):
            x, y = rng.uniform(-PLACES_M, PLACES_M, 2)
            pose = from_xyz_rpy((x, y, 0.5 * height_m), (0.0, 0.0, rng.uniform(0.0, math.pi)))
            body = Body("box", mesh, pose, Owner.UNKNOWN)
            found += reported_at(self._voxels(i, body), body)
        return found / frames

    def empty_share(self, frames: int) -> float:
        """Return the share of the frames of the empty table in which anything is reported."""
        found = sum(len(self._voxels(i)) > 0 for i in range(frames))
        return found / frames

    def thinnest_m(self, frames: int) -> float:
        """Return the thinnest box, in whole steps, that is reported often enough; NaN if not even the highest is."""
        lost, kept = 0, round(self._highest_m / STEP_M)
        if self.reported_share(kept * STEP_M, frames) < REPORTED_SHARE:
            return math.nan
        while kept - lost > 1:
            middle = (lost + kept) // 2
            if self.reported_share(middle * STEP_M, frames) >= REPORTED_SHARE:
                kept = middle
            else:
                lost = middle
        return kept * STEP_M

    def _voxels(self, i: int, *boxes: Body) -> Voxels:
        """Return the voxels of the next frame, on the lattice whose turn it is."""
        return self._pipelines[i % SHIFTS].process(self._stage.frame(*boxes).depth, None).voxels


@dataclass(frozen=True)
class AtMark:
    """Results for boxes of one height: share of reported frames with a box, and without."""

    distance_m: float
    height_m: float
    cad: bool
    frames: int
    reported_share: float
    empty_share: float


def trial(distance_m: float, height_m: float, cad: bool, frames: int, settings: FilterSettings) -> AtMark:
    """Test boxes of one height on one table."""
    boxes = Trial(distance_m, cad, settings, seed=1)
    reported = boxes.reported_share(height_m, frames)
    return AtMark(distance_m, height_m, cad, frames, reported, boxes.empty_share(frames))


def at_the_marks(found: list[AtMark]) -> Result:
    """Return the table, and the marks on CAD. A reported box means nothing if the empty table is reported, too."""
    rows = tuple(
        (_KIND[each.cad], each.distance_m, 1e3 * each.height_m, each.frames, *_percents(each)) for each in found
    )
    marks = []
    for each in found:
        name = f"{1e3 * each.height_m:.0f} mm on a {_KIND[each.cad]} table at {each.distance_m:g} m"
        reported, empty = _percents(each)
        marks.append(Mark(f"{name}: reported in % of frames", reported, at_least=100.0 * REPORTED_SHARE))
        marks.append(Mark(f"{name}: empty table reported in % of frames", empty, at_most=100.0 * EMPTY_SHARE_MAX))
    columns = ("table", "distance m", "height mm", "frames", "reported %", "empty table reported %")
    return Result("Thickness: boxes of 10 x 10 cm on a table", columns, rows, tuple(marks))


def point(distance_m: float, frames: int, settings: FilterSettings) -> tuple[float, float, float]:
    """Return the distance in metres, and the thinnest reported box in mm on a CAD table and on a learned one."""
    cad, learned = (Trial(distance_m, kind, settings, seed=2).thinnest_m(frames) for kind in (True, False))
    return distance_m, 1e3 * cad, 1e3 * learned


def curve(points: list[tuple[float, float, float]], frames: int) -> Result:
    """Return the thinnest boxes as a table."""
    return Result(
        f"Thinnest box of 10 x 10 cm that is reported in at least 99 % of {frames} frames",
        ("distance m", "on a CAD table mm", "on a learned table mm"),
        tuple(points),
    )


def _percents(each: AtMark) -> tuple[float, float]:
    return 100.0 * each.reported_share, 100.0 * each.empty_share


_KIND = {True: "CAD", False: "learned"}


@cache
def _box(height_m: float) -> TriangleMesh:
    return box_mesh("box", (SIDE_M, SIDE_M, height_m))
