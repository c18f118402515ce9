# SPDX-License-Identifier: Apache-2.0
"""People in the demo cell: the missed share of their visible surface, and the false voxels.

As in `simulation.cameras.truth`, a voxel is visible to a camera if it shows a tenth of the pinhole count. It is outside
the margin if as many of these points pass the filter at their true depth. It is missed if the merged map of all cameras
holds neither it nor one of its 26 neighbours; strictly missed if the map does not hold the voxel itself; missed by its
own camera if that camera reported neither. A report is false if nothing unknown has a surface in it or in a neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from benchmarks.reporting.report import Mark, Result
from benchmarks.sweep_scenes.quiet import CAMERAS, FRAME_S
from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.settings import FilterSettings
from simulation.cameras.camera import SimulatedCamera, rig
from simulation.cameras.truth import TruthFinder, false_voxels, missed_voxels
from simulation.world.world import World

MISSED_SHARE_MAX, FALSE_SHARE_MAX = 0.02, 0.005


@dataclass(frozen=True)
class Part:
    """Moments `first` to `last` (exclusive) of a cell with `people`, seen by all cameras."""

    people: int
    first: int
    last: int


@dataclass(frozen=True)
class Walk:
    """Counts over frames of one number of people. Voxels are counted again in each camera's frame."""

    people: int
    frames: int = 0
    false_frames: int = 0
    false_voxels: int = 0
    visible: int = 0
    outside: int = 0
    missed: int = 0
    missed_strictly: int = 0
    missed_alone: int = 0

    def __add__(self, other: Walk) -> Walk:
        counts = {each.name: getattr(self, each.name) + getattr(other, each.name) for each in fields(self)[1:]}
        return Walk(self.people, **counts)


def parts(people: int, moments: int, length: int) -> list[Part]:
    """Return `moments` of a cell in parts of at most `length`."""
    return [Part(people, first, min(first + length, moments)) for first in range(0, moments, length)]


class _Watcher:
    """One camera with its filter and its truth."""

    def __init__(self, world: World, index: int, intrinsics: Intrinsics, settings: FilterSettings) -> None:
        pose = rig(world.cell, CAMERAS)[index]
        self.camera = SimulatedCamera(world, pose, intrinsics, renderer="raycast", seed=index)
        self.pipeline = DepthPipeline(intrinsics, pose, world.cell, settings)
        self._true_pipeline = DepthPipeline(intrinsics, pose, world.cell, settings)
        self._finder = TruthFinder(intrinsics, pose, self.pipeline.lattice, self.camera.noise)
        self._scale_m = intrinsics.depth_scale_m

    def look(self, t_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the keys of the voxels that are reported, visible, visible and outside the margin, and of surfaces."""
        frame = self.camera.capture(t_s)
        reported = self.pipeline.process(frame.depth, frame.joints).voxels.keys
        true_raw = np.where(np.isfinite(frame.true_z_m), np.rint(frame.true_z_m / self._scale_m), 0.0)
        passes = self._true_pipeline.foreground(np.minimum(true_raw, 65535.0).astype(np.uint16), frame.joints)
        truth = self._finder.find(frame.view, np.where(passes, np.inf, 0.0).astype(np.float32))
        return reported, truth.visible_keys, truth.outside_keys, truth.surface_keys


def watch(part: Part, intrinsics: Intrinsics, settings: FilterSettings) -> Walk:
    """Filter the frames of one part. The joints are exact at the frame's time."""
    world = World.demo(people=part.people)
    watchers = [_Watcher(world, index, intrinsics, settings) for index in range(CAMERAS)]
    lattice = watchers[0].pipeline.lattice
    walk = Walk(part.people)
    for number in range(part.first, part.last):
        looks = [watcher.look(number * FRAME_S) for watcher in watchers]
        merged = np.unique(np.concatenate([reported for reported, *_ in looks]))
        for reported, visible, outside, surface in looks:
            false = len(false_voxels(reported, surface, lattice))
            walk += Walk(
                part.people,
                1,
                int(false > 0),
                false,
                len(visible),
                len(outside),
                len(missed_voxels(outside, merged, lattice)),
                len(missed_voxels(outside, merged, lattice, 0)),
                len(missed_voxels(outside, reported, lattice)),
            )
    return walk


def result(found: list[Walk], intrinsics: Intrinsics) -> Result:
    """Return one row per number of people."""
    rows: list[tuple[str | float, ...]] = []
    marks: list[Mark] = []
    for people in sorted({walk.people for walk in found}):
        walk = sum((each for each in found if each.people == people), Walk(people))
        missed, strictly, alone = (
            100.0 * count / max(walk.outside, 1) for count in (walk.missed, walk.missed_strictly, walk.missed_alone)
        )
        inside = 100.0 * (walk.visible - walk.outside) / max(walk.visible, 1)
        false = 100.0 * walk.false_frames / max(walk.frames, 1)
        rows.append((people, walk.frames, walk.visible, inside, missed, strictly, alone, false, walk.false_voxels))
        marks.append(Mark(f"{people} walking: visible voxels missed, %", missed, at_most=100.0 * MISSED_SHARE_MAX))
        marks.append(Mark(f"{people} walking: frames with false voxels, %", false, at_most=100.0 * FALSE_SHARE_MAX))
    return Result(
        f"People who walk and reach, {CAMERAS} cameras of {intrinsics.width}x{intrinsics.height}, rays by Embree",
        (
            "people",
            "frames",
            "visible voxels",
            "inside margin %",
            "missed %",
            "missed strictly %",
            "missed by own camera %",
            "frames with false %",
            "false voxels",
        ),
        tuple(rows),
        tuple(marks),
    )
