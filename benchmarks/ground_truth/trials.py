# SPDX-License-Identifier: Apache-2.0
"""Trials, in which all contenders get the same frames: a thing on the stage, blobs of wrong matches, a robot that moves
alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.ground_truth.rules import Filter, Measured, Place, Rule
from benchmarks.ground_truth.surface import Judge, Surface, Tally
from benchmarks.ground_truth.things import TILT_MAX_RAD, before_wall, placed
from benchmarks.sweep_scenes.quiet import CAMERAS, FRAME_S
from benchmarks.sweep_scenes.shapes import SPECKLE_PX, blob
from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.settings import FilterSettings
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.cameras.depth_noise import DepthNoise
from simulation.world.world import World

BLOB_NEAREST_M = 0.5
"""Smallest depth of a wrong match; the largest is the wall's."""


@dataclass(frozen=True)
class Entry:
    """One point of one line: axis, contender, x, and the rule and voxel size that produce it."""

    axis: str
    contender: str
    x: float
    rule: Rule
    voxel_size_m: float = FilterSettings().voxel_size_m


Tallies = list[tuple[Entry, Tally]]

RobotMask = Callable[[NDArray[np.uint16], NDArray[np.float64] | None], NDArray[np.bool_]]
"""Maps depth (H, W) and joints (n,) to the robot mask (H, W)."""


@dataclass(frozen=True)
class Trial:
    """`thing`, or nothing, at `distance_m` before a wall that is `behind_m` farther, with `blobs` wrong matches in each
    frame.

    `subject` is the name of the scene in the curves.
    """

    subject: str
    thing: str | None
    distance_m: float
    behind_m: float
    frames: int
    entries: tuple[Entry, ...]
    seed: int
    tilt_max_rad: float = TILT_MAX_RAD
    blobs: int = 0

    def run(self) -> Tallies:
        """Return the tally of each entry."""
        noise = DepthNoise()
        stage = before_wall(self.distance_m, self.behind_m, noise, self.seed)
        place = Place(stage.intrinsics, stage.T_world_camera, stage.cell)
        known_m = DepthPipeline(place.intrinsics, place.T_world_camera, place.cell).expected_depth(None)
        no_robot = np.zeros(stage.intrinsics.shape, np.bool_)
        contest = Contest(place, self.entries, noise)
        rng = np.random.default_rng(self.seed)
        for _ in range(self.frames):
            bodies = placed(self.thing, self.distance_m, rng, self.tilt_max_rad) if self.thing else ()
            frame = stage.frame(*bodies)
            _speckle(self.blobs, frame.depth, rng, self.distance_m + self.behind_m, place.intrinsics)
            surface = Surface.of(frame.view, place, noise, rng)
            contest.hold(Measured(frame.depth, None, known_m, no_robot), surface)
        return contest.tallies


@dataclass(frozen=True)
class QuietTrial:
    """The demo cell, in which only the robot moves, seen by one of its cameras: every reported voxel is false."""

    subject: str
    camera: int
    frames: int
    entries: tuple[Entry, ...]

    def run(self) -> Tallies:
        """Return the tally of each entry."""
        world, intrinsics, noise = World.demo(people=0), d435i_intrinsics(), DepthNoise()
        place = Place(intrinsics, rig(world.cell, CAMERAS)[self.camera], world.cell)
        camera = SimulatedCamera(world, place.T_world_camera, intrinsics, noise, "raycast", self.camera)
        known_m = DepthPipeline(intrinsics, place.T_world_camera, world.cell).expected_depth(None)
        robot_of = robot_mask(place, FilterSettings())
        contest = Contest(place, self.entries, noise)
        rng = np.random.default_rng(self.camera)
        for number in range(self.frames):
            frame = camera.capture(number * FRAME_S)
            robot = robot_of(frame.depth, frame.joints)
            surface = Surface.of(frame.view, place, noise, rng)
            contest.hold(Measured(frame.depth, frame.joints, known_m, robot), surface)
        return contest.tallies


class Contest:
    """Several entries with the same camera."""

    def __init__(self, place: Place, entries: tuple[Entry, ...], noise: DepthNoise) -> None:
        self.tallies: Tallies = [(entry, Tally()) for entry in entries]
        self._filters: list[Filter] = [entry.rule.at(place, entry.voxel_size_m) for entry in entries]
        sizes_m = {entry.voxel_size_m for entry in entries}
        self._judges = {size_m: Judge(place, place.cell.lattice(size_m), noise) for size_m in sizes_m}

    def hold(self, measured: Measured, surface: Surface) -> None:
        """Judge the voxels that each entry reports of one frame."""
        for (entry, tally), reported in zip(self.tallies, self._filters, strict=True):
            tally.add(self._judges[entry.voxel_size_m].judge(surface, reported(measured)))


def robot_mask(place: Place, settings: FilterSettings) -> RobotMask:
    """Return a mask function for the pixels that our padded robot explains: those that a filter with only the robot
    removes.
    """
    alone = replace(place.cell, static=(), objects=())
    pipeline = DepthPipeline(place.intrinsics, place.T_world_camera, alone, settings)

    def robot(depth: NDArray[np.uint16], joints: NDArray[np.float64] | None) -> NDArray[np.bool_]:
        return np.asarray((depth > 0) & ~pipeline.foreground(depth, joints))

    return robot


def _speckle(
    blobs: int, depth: NDArray[np.uint16], rng: np.random.Generator, farthest_m: float, camera: Intrinsics
) -> None:
    """Add wrong matches of up to `SPECKLE_PX` pixels to `depth` (H, W), each at a depth of its own."""
    for _ in range(blobs):
        rows, columns = blob(rng, int(rng.integers(1, SPECKLE_PX + 1)), camera)
        depth[rows, columns] = round(rng.uniform(BLOB_NEAREST_M, farthest_m) / camera.depth_scale_m)
