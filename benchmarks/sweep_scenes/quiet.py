# SPDX-License-Identifier: Apache-2.0
"""The demo cell, in which only its robot moves: every reported voxel is false.

Everything static is either in CAD, or learned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.reporting.report import Mark, Result
from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.settings import FilterSettings
from simulation.cameras.camera import SimulatedCamera, rig
from simulation.world.world import World

CAMERAS = 4

FRAME_S = 0.137
"""Time between frames. It divides neither the robot's period nor a step's, so the poses of both keep changing."""

LEARNED_FRAMES = 100
"""Ten seconds of the empty cell at ten frames a second, enough to fill in the robot's shadow."""

LEARNED_S = 0.1

FALSE_SHARE_MAX = 0.005

EXAMPLES = 8
"""Number of false voxels of a part that are listed."""


@dataclass(frozen=True)
class Part:
    """Frames `first` to `last` (exclusive) of one camera, in a cell in CAD or learned."""

    camera: int
    learned: bool
    first: int
    last: int


@dataclass(frozen=True)
class Quiet:
    """Results of a part: frames, frames with false voxels, false voxels, and a few of these in words."""

    camera: int
    learned: bool
    frames: int
    false_frames: int
    false_voxels: int
    examples: tuple[str, ...]


def parts(frames: int, length: int, learned_too: bool) -> list[Part]:
    """Return `frames` of each camera in parts of at most `length`, in a cell in CAD and optionally in a learned one."""
    return [
        Part(camera, learned, first, min(first + length, frames))
        for learned in (False, True)[: 1 + learned_too]
        for camera in range(CAMERAS)
        for first in range(0, frames, length)
    ]


def watch(part: Part, intrinsics: Intrinsics, settings: FilterSettings) -> Quiet:
    """Filter the frames of one part. The joints are exact at the frame's time."""
    world = World.demo(people=0)
    pose = rig(world.cell, CAMERAS)[part.camera]
    camera = SimulatedCamera(world, pose, intrinsics, renderer="raycast", seed=part.camera)
    known = replace(world.cell, static=(), objects=()) if part.learned else world.cell
    pipeline = DepthPipeline(intrinsics, pose, known, settings)
    if part.learned:
        before = (camera.capture(-LEARNED_S * (number + 1)) for number in range(LEARNED_FRAMES))
        pipeline.use(pipeline.learn((frame.depth, frame.joints) for frame in before))
    false_frames, false_voxels = 0, 0
    examples: list[str] = []
    for number in range(part.first, part.last):
        frame = camera.capture(number * FRAME_S)
        voxels = pipeline.process(frame.depth, frame.joints).voxels
        false_frames += len(voxels) > 0
        false_voxels += len(voxels)
        for centre, count in zip(voxels.lattice.centres(voxels.indices), voxels.counts, strict=True):
            if len(examples) < EXAMPLES:
                x, y, z = np.round(centre, 3)
                where = f"{_KIND[part.learned]} cell, camera {part.camera}, frame {number}"
                examples.append(f"{where}: {count} points at {x:g}, {y:g}, {z:g} m")
    return Quiet(part.camera, part.learned, part.last - part.first, false_frames, false_voxels, tuple(examples))


def result(found: list[Quiet], intrinsics: Intrinsics) -> Result:
    """Return one row per camera, and a mark for each kind of cell."""
    rows: list[tuple[str | float, ...]] = []
    marks = []
    for learned in sorted({each.learned for each in found}):
        kind = _KIND[learned]
        mine = [each for each in found if each.learned == learned]
        for camera in range(CAMERAS):
            rows.append((kind, str(camera), *_counts([each for each in mine if each.camera == camera])))
        rows.append((kind, "all", *_counts(mine)))
        share = float(rows[-1][-1])
        marks.append(Mark(f"{kind} cell: frames with false voxels, %", share, at_most=100.0 * FALSE_SHARE_MAX))
    return Result(
        f"Nothing but the moving robot, {CAMERAS} cameras of {intrinsics.width}x{intrinsics.height}, "
        "rays by Embree, joints exact at the frame's time",
        ("cell", "camera", "frames", "with false voxels", "false voxels", "with false voxels %"),
        tuple(rows),
        tuple(marks),
        tuple(example for each in found for example in each.examples)[:EXAMPLES],
    )


def _counts(found: list[Quiet]) -> tuple[int, int, int, float]:
    """Return frames, frames with false voxels, false voxels, and the share of the second in per cent."""
    frames, false_frames = sum(each.frames for each in found), sum(each.false_frames for each in found)
    return frames, false_frames, sum(each.false_voxels for each in found), 100.0 * false_frames / max(frames, 1)


_KIND = {False: "CAD", True: "learned"}
