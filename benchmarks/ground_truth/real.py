# SPDX-License-Identifier: Apache-2.0
"""The real recordings frame by frame: reported robot pixels, missed pixels of the second robot, and false voxels.

The frames with the second robot use a background model of the empty frames. Each empty frame uses a background model of
the other five, so no frame is judged by a model that it contributed to. Margins are at their defaults.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks import real_frames
from benchmarks.ground_truth.rules import Measured, MinimumPoints, Paper, Place, before
from benchmarks.ground_truth.trials import robot_mask
from benchmarks.real_frames import EMPTY_FRAMES, STEREO_FOCAL_PX, WATCHED_FRAMES, FrameMarks, RealFrames
from benchmarks.reporting.report import Mark, Result
from edge_unit.pipeline import DepthPipeline
from edge_unit.sources.recorded import RecordedSourceConfig, open_recording
from shared.settings import FilterSettings

LEAK_MAX_PERCENT, MISS_MAX_PERCENT, FALSE_MAX = 0.3, 2.5, 0

REPORTED, MISSED = "robot reported", "second robot missed"

Fixed = Mapping[str, Paper | MinimumPoints]
"""The contenders beside ours, by name."""


@dataclass(frozen=True)
class Judged:
    """Result of one contender on one frame."""

    contender: str
    frame: int
    marks: FrameMarks

    @property
    def is_watched(self) -> bool:
        """Return True if the frame shows the second robot."""
        return self.frame in WATCHED_FRAMES


def watch(ours: str, others: Fixed, settings: FilterSettings, held_out: int) -> list[Judged]:
    """Judge every frame by every contender, and the first `held_out` of the empty frames.

    Raises:
        SourceError: the recordings are not there.
    """
    folder = real_frames.find()
    cell = real_frames.cell(folder)
    info = open_recording(RecordedSourceConfig(folder=folder, fx_stereo=STEREO_FOCAL_PX))
    assert info.T_world_camera is not None
    pipeline = DepthPipeline(info.intrinsics, info.T_world_camera, cell, settings)
    place = Place(info.intrinsics, info.T_world_camera, cell)
    frames = real_frames.load(folder, pipeline)
    robot_of = robot_mask(place, settings)
    filters = {name: rule.at(place, settings.voxel_size_m) for name, rule in others.items()}

    def judge(frame: int) -> list[Judged]:
        depth, joints = frames.depth[frame], frames.joints[frame]
        found = [Judged(ours, frame, frames.marks(frame, pipeline.process(depth, joints).voxels))]
        measured = Measured(depth, joints, pipeline.expected_depth(None), robot_of(depth, joints))
        for name, rule in others.items():
            survives = before(place, measured, rule.limit_m)
            found.append(Judged(name, frame, frames.judge(frame, survives, filters[name](measured))))
        return found

    judged = [each for frame in WATCHED_FRAMES for each in judge(frame)]
    for frame in EMPTY_FRAMES[:held_out]:
        _learn(frames, [other for other in EMPTY_FRAMES if other != frame])
        judged += judge(frame)
    return judged


def _learn(frames: RealFrames, taught: list[int]) -> None:
    pipeline = frames.pipeline
    pipeline.use(pipeline.learn((frames.depth[frame], frames.joints[frame]) for frame in taught))


def results(judged: list[Judged], ours: str) -> list[Result]:
    """Return one row per frame and contender, and the distributions."""
    columns = ("contender", "frame", "robot reported %", "second robot missed %", "its voxels", "false voxels")
    rows: list[tuple[str | float, ...]] = []
    for each in judged:
        found = each.marks
        second = (found.second_robot_miss_percent, found.second_robot_voxels) if each.is_watched else (math.nan,) * 2
        rows.append((each.contender, each.frame, found.robot_leak_percent, *second, _false(each)))
    note = (
        "Frames 0 to 3 show a second robot and use a background model of the empty frames. Frames 4 to 9"
        " are empty, and each uses a background model of the other five. All contenders share the "
        "background model and the robot mask.",
    )
    return [
        Result("Real frames, one by one", columns, tuple(rows), remarks=(*note, *remarks(judged, ours))),
        Result(
            "Real frames, % of pixels in a frame", ("contender", "figure", "median", "95 %", "worst"),
            tuple(_distributions(judged)),
        ),
    ]  # fmt: skip


def marks(judged: list[Judged], ours: str) -> list[Mark]:
    """Return our filter's marks: the robot over all frames, the rest over frames with a complete background model."""
    mine = [each for each in judged if each.contender == ours]
    leak = max(each.marks.robot_leak_percent for each in mine)
    miss = max(each.marks.second_robot_miss_percent for each in mine if each.is_watched)
    false = max(_false(each) for each in mine if each.is_watched)
    return [
        Mark("real frames: robot reported, % of its pixels, worst frame", leak, at_most=LEAK_MAX_PERCENT),
        Mark("real frames: second robot missed, % of its pixels, worst frame", miss, at_most=MISS_MAX_PERCENT),
        Mark("real frames: false voxels, worst frame", false, at_most=FALSE_MAX),
    ]


def remarks(judged: list[Judged], ours: str) -> list[str]:
    """List the false voxels that come of a background of few frames, and the figures in which others miss less."""
    mine = [each for each in judged if each.contender == ours]
    said = [
        f"Real frame {each.frame}, empty, by a background of the other five: {_false(each)} false voxels."
        for each in mine
        if not each.is_watched and _false(each)
    ]
    missed = {name: figures for name, label, *figures in _distributions(judged) if label == MISSED}
    voxels = {
        name: min(e.marks.second_robot_voxels for e in judged if e.contender == name and e.is_watched)
        for name in missed
    }
    for other, (median, *_) in missed.items():
        if median < missed[ours][0]:
            said.append(
                f"Worse than {other} on real frames, second robot missed in % of its pixels, median: "
                f"{missed[ours][0]:.3g} beside {median:.3g}; of its voxels ours reports {voxels[ours]}, {other} "
                f"{voxels[other]} in the poorest frame, with at most "
                f"{max(_false(e) for e in mine if e.is_watched)} and "
                f"{max(_false(e) for e in judged if e.contender == other and e.is_watched)} false ones."
            )
    return said


def _false(each: Judged) -> int:
    """Return the number of false voxels. If the second robot is gone, its voxels are false, too."""
    found = each.marks
    return found.false_voxels + (0 if each.is_watched else found.second_robot_voxels)


def _distributions(judged: list[Judged]) -> list[tuple[str, str, float, float, float]]:
    """Return contender, figure, median, 95 % and maximum over the frames."""
    found = []
    for name in dict.fromkeys(each.contender for each in judged):
        mine = [each for each in judged if each.contender == name]
        leaks = [each.marks.robot_leak_percent for each in mine]
        misses = [each.marks.second_robot_miss_percent for each in mine if each.is_watched]
        for label, values in ((REPORTED, leaks), (MISSED, misses)):
            median, p95, highest = (round(float(np.quantile(values, at)), 4) for at in (0.5, 0.95, 1.0))
            found.append((name, label, median, p95, highest))
    return found
