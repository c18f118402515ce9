# SPDX-License-Identifier: Apache-2.0
"""The joints' delay from a recording that has the times of both: `edge-unit joint-delay DIR --cell cell.yaml`.

DIR is a folder as the `recorded` source reads it, with its camera's pose, and two more files beside the images:
`frame_times_s.csv`, a row for each frame, and `joint_samples.csv`, rows of time in s and positions in rad (m if
prismatic).
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_unit.joints.delay_estimation import DelayComparison, DelayEstimate, compare_frame, estimate_delay
from edge_unit.joints.history import EXTRAPOLATION_MAX_S
from edge_unit.pipeline import DepthPipeline
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from shared.cell import Cell
from shared.errors import InputError, SourceError
from shared.settings import FilterSettings
from shared.text_files import parse_numbers, read_text

FRAME_TIMES = "frame_times_s.csv"
JOINT_SAMPLES = "joint_samples.csv"

MAX_FILE_BYTES = 256 * 2**20
"""An hour of seven joints at 500 Hz."""


def delay_of_recording(config: RecordedSourceConfig, cell: Cell) -> DelayEstimate:
    """Estimate the delay of a recording's joints.

    Raises:
        SourceError: a file is missing or malformed; names it.
        InputError: the cell has no robot or the recording no pose; or as `estimate_delay` raises.
    """
    return asyncio.run(_delay(config, cell))


async def _delay(config: RecordedSourceConfig, cell: Cell) -> DelayEstimate:
    robot = cell.robot
    if robot is None:
        raise InputError(f"cell {cell.name}: expected a cell with a robot, got none: choose another with --cell")
    times_s = _table(config.folder / FRAME_TIMES, 1)[:, 0]
    samples = JointSamples(_table(config.folder / JOINT_SAMPLES, 1 + robot.joint_count), config.folder / JOINT_SAMPLES)
    source = RecordedSource(config)
    info = await source.open()
    if info.T_world_camera is None:
        raise InputError(f"{config.folder / config.pose}: expected the camera's pose, there is no such file")
    settings = FilterSettings()
    static_m = DepthPipeline(info.intrinsics, info.T_world_camera, cell, settings).expected_depth(None)
    comparison = DelayComparison(info.intrinsics, info.T_world_camera, robot, static_m, settings)
    found, count = [], 0
    async for frame in source.frames():
        if count < len(times_s):
            misfits = compare_frame(comparison, frame.depth, float(times_s[count]), samples.at)
            found += [] if misfits is None else [misfits]
        count += 1
    if count != len(times_s):
        raise SourceError(
            f"{config.folder / FRAME_TIMES}: expected a row for each of {count} frames, not {len(times_s)}"
        )
    return estimate_delay(found)


class JointSamples:
    """Samples (N, 1 + n) of time in s and positions, interpolated."""

    def __init__(self, samples: NDArray[np.float64], path: Path) -> None:
        """Raises SourceError, which names `path`, if times do not rise."""
        if not (np.diff(samples[:, 0]) > 0.0).all():
            raise SourceError(f"{path}: expected rising times")
        self._times_s, self._positions = samples[:, 0], samples[:, 1:]

    def at(self, t_s: float) -> NDArray[np.float64] | None:
        """Return positions (n,) at `t_s`; None without samples close in time on both sides."""
        after = int(np.searchsorted(self._times_s, t_s))
        if not 0 < after < len(self._times_s) or np.diff(self._times_s[after - 1 : after + 1]) > EXTRAPOLATION_MAX_S:
            return None
        share = (t_s - self._times_s[after - 1]) / (self._times_s[after] - self._times_s[after - 1])
        return np.asarray((1.0 - share) * self._positions[after - 1] + share * self._positions[after])


def _table(path: Path, columns: int) -> NDArray[np.float64]:
    """Return rows of so many finite numbers."""
    try:
        table = parse_numbers(read_text(path))
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: {' '.join(str(error).split())}") from error
    if table.shape[1] != columns:
        raise SourceError(f"{path}: expected rows of {columns} numbers, got {table.shape[1]}")
    return table
