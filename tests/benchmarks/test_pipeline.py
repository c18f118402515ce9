# SPDX-License-Identifier: Apache-2.0
"""Measurement of the pipeline: turns, medians, and frames with the promised share of foreground."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from benchmarks import pipeline
from benchmarks.peers.ur3_scene import room
from benchmarks.pipeline import FRAMES_A_TURN, Part, Spent, in_turns
from shared.transforms import look_at
from simulation.cameras.camera import d435i_intrinsics

needs_peers = pytest.mark.skipif(
    importlib.util.find_spec("open3d") is None or importlib.util.find_spec("octomap") is None,
    reason="the peers are not installed (make bench-pipeline adds them)",
)


def test_contenders_take_turns_over_the_same_frames() -> None:
    done: list[tuple[str, int]] = []
    spent = in_turns({name: lambda n, name=name: done.append((name, n)) for name in "ab"}, turns=2, frames=4)
    each = [[0, 1, 2], [3, 0, 1], [2, 3, 0]]
    assert done == [(name, n) for turn in each for name in "ab" for n in turn]
    assert [len(spent[name].turns) for name in "ab"] == [2, 2]
    assert all(len(turn) == FRAMES_A_TURN for turn in spent["a"].turns)


def test_only_a_returned_part_counts() -> None:
    """A number that some work returns is not its duration."""
    spent = in_turns({"part": lambda _n: Part(5_000_000), "number": lambda n: 5_000_000_000 + n}, turns=1, frames=4)
    assert spent["part"].turns == [[5.0] * FRAMES_A_TURN]
    assert max(spent["number"].turns[0]) < 5000.0


def test_the_first_frame_of_a_turn_is_listed_separately() -> None:
    spent = Spent()
    spent.turns = [[5.0, 1.0, 1.0], [7.0, 1.0, 1.0], [6.0, 1.0, 1.0]]
    assert spent.median == 1.0
    assert spent.first == 6.0


@pytest.mark.skipif(importlib.util.find_spec("dufomap") is None, reason="there is none for this processor")
@needs_peers
def test_dufomap_marks_the_space_before_its_points() -> None:
    from benchmarks.peers import contenders

    cell = room()
    camera = contenders.Camera(d435i_intrinsics(424, 240), look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), cell)
    dufomap = contenders.DUFOMap(camera, 0.05)
    side_m = np.linspace(-0.5, 0.5, 80)
    wall_m = np.stack(np.meshgrid([2.0], side_m, side_m), axis=-1).reshape(-1, 3)
    for _ in range(3):
        dufomap.insert(wall_m)
    assert dufomap.in_free_space(0.5 * wall_m).all()
    assert not dufomap.in_free_space(wall_m).any()
    assert not dufomap.in_free_space(1.3 * wall_m).any()


@needs_peers
@pytest.mark.slow
def test_a_small_run_finds_every_figure_and_ours_ahead() -> None:
    frames = pipeline.record(424, 240, 4)
    figures, marks = pipeline.compare(frames, turns=3)
    assert figures["foreground_share"] == pytest.approx(0.1, abs=0.02)
    assert {mark.name for mark in marks} >= {
        "frame to voxels, times faster than Open3D",
        "filter, in memcpys of two images",
    }
    # Ratios of one run on a busy machine: far from the marks, yet far from equal.
    assert figures["vs_open3d"] > 5.0
    assert figures["vs_octomap"] > 5.0
    assert figures["worst_case_vs_open3d"] > 3.0
