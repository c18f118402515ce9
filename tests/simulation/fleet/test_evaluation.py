# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.monitoring import Trace, TraceRecord
from edge_unit.pipeline import DepthPipeline
from edge_unit.sources.simulated import SimulatedSource, SimulatedSourceConfig
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns
from shared.errors import InputError
from shared.settings import FilterSettings
from simulation.fleet.evaluation import UnitRun, evaluate
from simulation.fleet.truth_file import TruthWriter
from simulation.world.world import World

FRAMES = 4
FPS = 30.0
LATE_MS = 25

Change = Callable[[NDArray[np.uint32]], NDArray[np.uint32]]


class Recorded:
    """Truth and reports of two units; the reports may be changed before they are written."""

    def __init__(self, folder: Path) -> None:
        self.settings = FilterSettings()
        self.epoch_ns = monotonic_ns() - 100 * NS_PER_S
        self.sources = [
            SimulatedSourceConfig(camera=camera, cameras=2, fps=FPS, epoch_ns=self.epoch_ns) for camera in range(2)
        ]
        self._folder = folder
        self.reports: list[list[TraceRecord]] = [asyncio.run(self._look(source)) for source in self.sources]
        self.times = (self.epoch_ns, monotonic_ns())

    async def _look(self, config: SimulatedSourceConfig) -> list[TraceRecord]:
        world = World.demo()
        writer = TruthWriter(self._truth_path(config), self.settings.voxel_size_m)
        source = SimulatedSource(config, observer=writer)
        info = await source.open()
        assert info.T_world_camera is not None
        pipeline = DepthPipeline(info.intrinsics, info.T_world_camera, world.cell, self.settings)
        lattice, records = pipeline.lattice, []
        async for frame in source.frames():
            joints = world.joints_at((frame.captured_at_ns - self.epoch_ns) / NS_PER_S)
            keys = pipeline.process(frame.depth, joints).voxels.keys.astype("<u4").tobytes()
            merged_at_ns = frame.captured_at_ns + LATE_MS * NS_PER_MS
            records.append(
                TraceRecord(
                    frame.frame_number, frame.captured_at_ns, 1.5, keys, lattice.shape, lattice.voxel_size_m, True,
                    merged_at_ns,
                )
            )  # fmt: skip
            if len(records) == FRAMES:
                break
        await source.close()
        return records

    def _truth_path(self, source: SimulatedSourceConfig) -> Path:
        return self._folder / f"{source.camera}.truth"

    def runs(self, change: Change = lambda keys: keys, drop: int = 0) -> list[UnitRun]:
        """The record of both units, with each report changed and the last few never sent."""
        runs = []
        for source, records in zip(self.sources, self.reports, strict=True):
            path = self._folder / f"{source.camera}.trace"
            trace = Trace(path)
            for index, record in enumerate(records):
                keys = change(np.frombuffer(record.keys, "<u4")).astype("<u4").tobytes()
                sent = index < FRAMES - drop
                trace.add(replace(record, keys=keys, sent=sent, merged_at_ns=record.merged_at_ns if sent else None))
            trace.close()
            runs.append(UnitRun(f"unit-{source.camera}", source, path, self._truth_path(source)))
        return runs


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return Recorded(tmp_path_factory.mktemp("recorded"))


def test_honest_reports_miss_nobody(recorded: Recorded) -> None:
    figures = evaluate(recorded.runs(), recorded.settings, *recorded.times)
    assert figures["frames"] == 2 * FRAMES
    assert figures["frames_with_false_voxels"] == 0
    assert figures["visible_voxels"] > 100 * figures["frames"]
    assert 0.0 < figures["margin_fraction"] < 0.3
    assert figures["missed_fraction"] < 0.05
    assert figures["missed_fraction"] < figures["missed_fraction_strict"] < 0.25
    assert figures["capture_to_map_ms_p50"] == figures["capture_to_map_ms_p99"] == LATE_MS
    assert figures["frame_ms_p50"] == 1.5


def test_units_that_report_nothing_miss_everybody(recorded: Recorded) -> None:
    figures = evaluate(recorded.runs(lambda keys: keys[:0]), recorded.settings, *recorded.times)
    assert figures["missed_fraction"] == figures["missed_fraction_strict"] == 1.0
    assert figures["voxels_mean"] == 0.0


def test_what_one_unit_reports_counts_for_the_other(recorded: Recorded) -> None:
    whole = recorded.runs()
    silent = recorded.runs(lambda keys: keys[:0])[1]
    silent_path = silent.trace_path.rename(silent.trace_path.with_suffix(".silent"))
    recorded.runs()
    runs = [whole[0], replace(silent, trace_path=silent_path)]
    figures = evaluate(runs, recorded.settings, *recorded.times)
    # What only the silent one sees is missed, what both see is not.
    assert 0.05 < figures["missed_fraction"] < 0.95


def test_a_voxel_where_nothing_stands_is_false(recorded: Recorded) -> None:
    # The first voxel of the lattice: a corner of the box at the floor, where nobody walks.
    changed = recorded.runs(lambda keys: np.union1d(keys, np.zeros(1, np.uint32)))
    figures = evaluate(changed, recorded.settings, *recorded.times)
    assert figures["frames_with_false_voxels"] == figures["frames"] == figures["false_voxels"]
    assert figures["false_frame_fraction"] == 1.0


def test_frames_that_were_never_merged_are_dropped_frames(recorded: Recorded) -> None:
    figures = evaluate(recorded.runs(drop=1), recorded.settings, *recorded.times)
    assert figures["frames"] == 2 * (FRAMES - 1)
    # The camera may have captured one more before it was closed.
    assert figures["frames_dropped"] >= 2
    seconds = (recorded.times[1] - recorded.times[0]) / NS_PER_S
    assert figures["fps_per_unit"] == [round((FRAMES - 1) / seconds, 2)] * 2


def test_only_frames_of_the_time_count(recorded: Recorded) -> None:
    second = recorded.reports[0][1].captured_at_ns
    figures = evaluate(recorded.runs()[:1], recorded.settings, second, second + 1)
    assert figures["frames"] == 1
    with pytest.raises(InputError, match="got none"):
        evaluate(recorded.runs(), recorded.settings, 0, 1)


def test_the_truth_of_another_camera_is_found_out(recorded: Recorded) -> None:
    run = recorded.runs()[0]
    other = replace(run, source=run.source.model_copy(update={"seed": 1}))
    with pytest.raises(InputError, match="truth of unit-0's camera"):
        evaluate([other], recorded.settings, *recorded.times)


def test_truth_of_other_voxels_is_refused(recorded: Recorded) -> None:
    with pytest.raises(InputError, match=r"expected truth for voxels of 0\.03 m"):
        evaluate(recorded.runs(), FilterSettings(voxel_size_m=0.03), *recorded.times)


def test_a_truth_file_that_is_none_is_named(recorded: Recorded, tmp_path: Path) -> None:
    path = tmp_path / "truth"
    path.write_bytes(msgpack.packb({"captured_at_ns": 1}))
    run = recorded.runs()[0]
    broken = replace(run, truth_path=path)
    with pytest.raises(InputError, match=str(path)):
        evaluate([broken], recorded.settings, *recorded.times)
