# SPDX-License-Identifier: Apache-2.0
"""Evaluation of a run of simulated units: their reports compared with the truth.

The time of capture joins each frame's report (`edge_unit.monitoring.trace`) with its truth
(`simulation.fleet.truth_file`). A frame counts if its time of capture is between two given times.

*False*: a reported voxel without a true surface of an unknown thing in itself or in one of its 26 neighbours, by the
truth of the same frame. `simulation.cameras.truth` defines how far noise may move a surface.

*Missed*: a visible voxel outside the margins that the merged map does not hold. Visible means that the frame shows at
least a tenth of its pinhole count. The merged map is the union of the last reports of all units, at the moment at which
the master has merged the frame. Noise of centimetres moves points over the borders of voxels, so there are two figures.
`missed_fraction` counts a voxel as reported if the map holds it or one of its 26 neighbours. `missed_fraction_strict`
counts it only if the map holds the voxel itself.

*Outside the margins*: the pixels that pass the filter if its input is the true depth and the true joints, without any
allowance for uncertain joints. `margin_fraction` is the share of the visible voxels that are not outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_unit.monitoring import TraceRecord, read_trace
from edge_unit.pipeline import DepthPipeline
from edge_unit.sources.simulated import SimulatedSourceConfig
from shared.cell import Cell
from shared.clock import NS_PER_MS, NS_PER_S
from shared.errors import InputError
from shared.settings import FilterSettings
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.cameras.truth import FrameTruth, TruthFinder, false_voxels, missed_voxels
from simulation.fleet.truth_file import KEYS, TrueFrame, read_truth
from simulation.world.scene import View
from simulation.world.world import World

MISSED_REACH = 1
"""Distance in voxels along each axis within which a report counts for `missed_fraction`."""


@dataclass(frozen=True)
class UnitRun:
    """One unit after a run: its camera, the file with its reports, and the file with the truth of its frames."""

    name: str
    source: SimulatedSourceConfig
    trace_path: Path
    truth_path: Path


class MarginFinder:
    """Renders a simulated camera's frames once more, and finds the visible voxels that the filter may leave out."""

    def __init__(self, source: SimulatedSourceConfig, settings: FilterSettings) -> None:
        self._source = source
        world = World.demo(source.people, source.seed, Cell.load(source.cell) if source.cell else None)
        pose = rig(world.cell, source.cameras)[source.camera]
        self._intrinsics = d435i_intrinsics(source.width, source.height)
        self._camera = SimulatedCamera(world, pose, self._intrinsics)
        self._pipeline = DepthPipeline(self._intrinsics, pose, world.cell, settings)
        self.lattice = self._pipeline.lattice
        self._finder = TruthFinder(self._intrinsics, pose, self.lattice, self._camera.noise)

    def truth(self, captured_at_ns: int) -> FrameTruth:
        """Return the truth of the frame with this time of capture, margins included."""
        t_s = (captured_at_ns - self._source.epoch_ns) / NS_PER_S
        view = self._camera.look(t_s)
        passes = self._pipeline.foreground(self._raw(view), self._camera.world.joints_at(t_s))
        return self._finder.find(view, np.where(passes, np.inf, 0.0).astype(np.float32))

    def _raw(self, view: View) -> NDArray[np.uint16]:
        """Return the true depth as a perfect camera delivers it: (H, W) uint16 in units of `depth_scale_m`."""
        raw = np.rint(np.where(np.isfinite(view.z_m), view.z_m, 0.0) / self._intrinsics.depth_scale_m)
        return np.minimum(raw, np.iinfo(np.uint16).max).astype(np.uint16)


@dataclass
class _Tally:
    """Counts over all frames."""

    frames: int = 0
    dropped: int = 0
    false_frames: int = 0
    false_voxels: int = 0
    visible: int = 0
    outside: int = 0
    missed: int = 0
    missed_strict: int = 0


def evaluate(units: Sequence[UnitRun], settings: FilterSettings, begin_ns: int, end_ns: int) -> dict[str, Any]:
    """Return the figures of all frames captured in [`begin_ns`, `end_ns`), by CLOCK_MONOTONIC.

    The times of several units are compared, so all units must have run on one machine.

    Raises:
        ConfigError: a trace cannot be read.
        InputError: a truth file cannot be read, or is of another camera or of other voxels; no frame is in the time.
    """
    traces = [read_trace(unit.trace_path) for unit in units]
    truths = [_true_frames(unit, settings, begin_ns, end_ns) for unit in units]
    margins = [MarginFinder(unit.source, settings) for unit in units]
    merged = sorted(
        (
            (record.merged_at_ns, index, record)
            for index, trace in enumerate(traces)
            for record in trace
            if record.merged_at_ns is not None
        ),
        key=lambda item: item[:2],
    )
    latest: list[NDArray[np.uint32]] = [np.empty(0, np.uint32) for _ in units]
    tally = _Tally()
    counts = [0] * len(units)
    process_ms: list[float] = []
    to_map_ms: list[float] = []
    map_sizes: list[int] = []
    for merged_at_ns, index, record in merged:
        latest[index] = np.frombuffer(record.keys, KEYS)
        true = truths[index].get(record.captured_at_ns)
        if true is None:
            continue
        whole = np.unique(np.concatenate(latest))
        _judge(tally, units[index], record, true, margins[index], whole)
        counts[index] += 1
        process_ms.append(record.process_ms)
        to_map_ms.append((merged_at_ns - record.captured_at_ns) / NS_PER_MS)
        map_sizes.append(len(whole))
    if not tally.frames:
        raise InputError("evaluation: expected frames in the time that is evaluated, got none; run for a longer time")
    tally.dropped = sum(map(len, truths)) - tally.frames
    seconds = (end_ns - begin_ns) / NS_PER_S
    return {
        "fps_per_unit": [round(count / seconds, 2) for count in counts],
        "frames": tally.frames,
        "frames_dropped": tally.dropped,
        "voxels_mean": round(float(np.mean(map_sizes)), 1),
        **_percentiles("frame_ms", process_ms),
        **_percentiles("capture_to_map_ms", to_map_ms),
        "frames_with_false_voxels": tally.false_frames,
        "false_frame_fraction": round(tally.false_frames / tally.frames, 6),
        "false_voxels": tally.false_voxels,
        "visible_voxels": tally.visible,
        "margin_fraction": _share(tally.visible - tally.outside, tally.visible),
        "missed_fraction": _share(tally.missed, tally.outside),
        "missed_fraction_strict": _share(tally.missed_strict, tally.outside),
        "missed_definition": "visible voxels outside the margins, of which the merged map holds neither the voxel nor "
        "one of its 26 neighbours when the frame has been merged; strict: not the voxel itself",
    }


def _judge(
    tally: _Tally,
    unit: UnitRun,
    record: TraceRecord,
    true: TrueFrame,
    margins: MarginFinder,
    whole: NDArray[np.uint32],
) -> None:
    """Count the false and the missed voxels of one frame; `whole` are the keys of the merged map."""
    lattice = margins.lattice
    if record.shape != lattice.shape or record.voxel_size_m != lattice.voxel_size_m:
        raise InputError(
            f"{unit.trace_path}: expected voxels of {lattice.voxel_size_m} m, {lattice.shape} of them, "
            f"got {record.voxel_size_m} m and {record.shape}"
        )
    truth = margins.truth(record.captured_at_ns)
    if not np.array_equal(truth.visible_keys, true.visible_keys):
        raise InputError(
            f"{unit.truth_path}: expected the truth of {unit.name}'s camera at {true.captured_at_ns} ns, "
            "got other voxels; name the file that belongs to this unit"
        )
    false = len(false_voxels(np.frombuffer(record.keys, KEYS), true.surface_keys, lattice))
    outside = truth.outside_keys
    tally.frames += 1
    tally.false_frames += false > 0
    tally.false_voxels += false
    tally.visible += len(truth.visible_keys)
    tally.outside += len(outside)
    tally.missed += len(missed_voxels(outside, whole, lattice, MISSED_REACH))
    tally.missed_strict += len(missed_voxels(outside, whole, lattice, 0))


def _true_frames(unit: UnitRun, settings: FilterSettings, begin_ns: int, end_ns: int) -> dict[int, TrueFrame]:
    """Return the truth of a unit's frames within the time, by time of capture."""
    found = {}
    for frame in read_truth(unit.truth_path):
        if frame.voxel_size_m != settings.voxel_size_m:
            raise InputError(
                f"{unit.truth_path}: expected truth for voxels of {settings.voxel_size_m} m, got {frame.voxel_size_m} m"
            )
        if begin_ns <= frame.captured_at_ns < end_ns:
            found[frame.captured_at_ns] = frame
    return found


def _percentiles(name: str, values_ms: list[float]) -> dict[str, float]:
    return {f"{name}_p{q}": round(float(np.percentile(values_ms, q)), 2) for q in (50, 99)}


def _share(part: int, whole: int) -> float | None:
    """Return `part / whole`, or None if `whole` is 0: a cell without people has nothing to miss."""
    return round(part / whole, 6) if whole else None
