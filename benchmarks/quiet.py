# SPDX-License-Identifier: Apache-2.0
"""The demo cell in which nothing moves but its robot: every voxel that is reported is a false one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.report import Mark, Result
from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.settings import FilterSettings
from simulation.camera import SimulatedCamera, rig
from simulation.world import World

CAMERAS = 4

FRAME_S = 0.137
"""Between frames; no part of the robot's period, so that it is met in ever other poses."""

FALSE_SHARE_MAX = 0.005

EXAMPLES = 8
"""False voxels of a part that are told one by one."""


@dataclass(frozen=True)
class Part:
    """Frames `first` to `last` (exclusive) of one camera."""

    camera: int
    first: int
    last: int


@dataclass(frozen=True)
class Quiet:
    """What came of a part: frames, frames with false voxels, false voxels, and a few of these in words."""

    camera: int
    frames: int
    false_frames: int
    false_voxels: int
    examples: tuple[str, ...]


def parts(frames: int, length: int) -> list[Part]:
    """`frames` of each camera, in parts of at most `length`."""
    return [
        Part(camera, first, min(first + length, frames))
        for camera in range(CAMERAS)
        for first in range(0, frames, length)
    ]


def watch(part: Part, intrinsics: Intrinsics, settings: FilterSettings) -> Quiet:
    """Look at the cell; the joints are those of the frame's time, exactly."""
    world = World.demo(people=0)
    pose = rig(world.cell, CAMERAS)[part.camera]
    camera = SimulatedCamera(world, pose, intrinsics, renderer="raycast", seed=part.camera)
    pipeline = DepthPipeline(intrinsics, pose, world.cell, settings)
    false_frames, false_voxels = 0, 0
    examples: list[str] = []
    for number in range(part.first, part.last):
        frame = camera.capture(number * FRAME_S)
        voxels = pipeline.process(frame.depth, frame.joints)
        false_frames += len(voxels) > 0
        false_voxels += len(voxels)
        for centre, count in zip(voxels.lattice.centres(voxels.indices), voxels.counts, strict=True):
            if len(examples) < EXAMPLES:
                x, y, z = np.round(centre, 3)
                examples.append(f"camera {part.camera}, frame {number}: {count} points at {x:g}, {y:g}, {z:g} m")
    return Quiet(part.camera, part.last - part.first, false_frames, false_voxels, tuple(examples))


def result(found: list[Quiet], intrinsics: Intrinsics) -> Result:
    """One row a camera, and the mark over all of them."""
    rows: list[tuple[str | float, ...]] = []
    for camera in range(CAMERAS):
        mine = [each for each in found if each.camera == camera]
        frames, false_frames = sum(each.frames for each in mine), sum(each.false_frames for each in mine)
        voxels = sum(each.false_voxels for each in mine)
        rows.append((str(camera), frames, false_frames, voxels, 100.0 * false_frames / max(frames, 1)))
    frames, false_frames = sum(each.frames for each in found), sum(each.false_frames for each in found)
    share = 100.0 * false_frames / max(frames, 1)
    rows.append(("all", frames, false_frames, sum(each.false_voxels for each in found), share))
    return Result(
        f"Nothing but the moving robot, {CAMERAS} cameras of {intrinsics.width}x{intrinsics.height}, "
        "rays by Embree, joints exact at the frame's time",
        ("camera", "frames", "with false voxels", "false voxels", "with false voxels %"),
        tuple(rows),
        (Mark("frames with false voxels, %", share, at_most=100.0 * FALSE_SHARE_MAX),),
        tuple(example for each in found for example in each.examples)[:EXAMPLES],
    )
