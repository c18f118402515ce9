# SPDX-License-Identifier: Apache-2.0
"""`make bench-pipeline`: what a frame costs, beside Open3D, OctoMap, Embree and a memcpy on the same frames.

All on one thread and in turns, so that whatever else the machine does falls on all of them; figures are medians of the
rounds, ratios those of medians. Peers are given for nothing what does not change from frame to frame.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers import Camera, Embree, OctoMap, Open3D
from benchmarks.report import RESULTS, Mark, table
from benchmarks.ur3_scene import record
from shared.clock import NS_PER_MS, stage_ns
from shared.errors import CellwatchError

VOXEL_M = 0.02
WORST_VOXEL_M = 0.01
VOXEL_SIZES_M = (0.01, 0.02, 0.03, 0.05, 0.1)
RESOLUTIONS = ((424, 240), (640, 480), (848, 480), (1280, 720))
FRAMES = 8
TABLE_ROUNDS = 24


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the tables, and one JSON line last. Exit code 1 when a mark is missed."""
    options = _parser().parse_args(arguments)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    try:
        result, marks = measure(options.rounds)
    except CellwatchError as error:
        print(f"make bench-pipeline: {error}", file=sys.stderr)
        return 1
    for mark in marks:
        print(mark)
    result["marks"] = [mark.document() for mark in marks]
    options.results.mkdir(parents=True, exist_ok=True)
    (options.results / "pipeline.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result))
    return 0 if all(mark.met for mark in marks) else 1


def measure(rounds: int) -> tuple[dict[str, Any], list[Mark]]:
    """All figures, by name, and the marks that they are held against."""
    frames = record(1280, 720, FRAMES)
    pipeline = frames.pipeline(VOXEL_M)
    empty = frames.pipeline_that_knows_nothing(WORST_VOXEL_M)
    camera = Camera(frames.intrinsics, frames.T_world_camera, frames.cell)
    open3d, embree = Open3D(camera, pipeline.settings), Embree(camera)
    octomap = OctoMap(camera, VOXEL_M)
    points_m = [
        camera.points_m(depth, pipeline.foreground(depth, joints))
        for depth, joints in zip(frames.depth, frames.joints, strict=True)
    ]
    one, other = np.zeros(frames.intrinsics.shape, np.uint16), np.zeros(frames.intrinsics.shape, np.uint16)
    everything = np.ones(frames.intrinsics.shape, np.bool_)

    def copy(n: int) -> None:
        np.copyto(one, frames.depth[n])
        np.copyto(other, frames.unhindered[n])

    contenders: dict[str, Callable[[int], object]] = {
        "process": lambda n: pipeline.process(frames.depth[n], frames.joints[n]),
        "open3d": lambda n: open3d.process(frames.depth[n], frames.joints[n], VOXEL_M),
        "octomap": lambda n: octomap.insert(points_m[n]),
        "expected depth": lambda n: pipeline.expected_depth(frames.joints[n]),
        "embree": lambda n: embree.expected_depth(frames.joints[n]),
        "memcpy": copy,
        "worst case": lambda n: empty.process(frames.unhindered[n], None),
        "open3d, all points at 20 mm": lambda n: open3d.voxels(frames.unhindered[n], everything, VOXEL_M),
    }
    spent_ms: dict[str, list[float]] = {name: [] for name in (*contenders, "robot layer")}
    for turn in range(rounds + 2):
        for name, work in contenders.items():
            began_ns = stage_ns()
            work(turn % FRAMES)
            took_ms = (stage_ns() - began_ns) / NS_PER_MS
            # The first two rounds compile and warm up.
            if turn >= 2:
                spent_ms[name].append(took_ms)
                if name == "process":
                    spent_ms["robot layer"].append(pipeline.last.expected_ns / NS_PER_MS)
    median = {name: float(np.median(times)) for name, times in spent_ms.items()}
    rows = [(name, value, float(np.percentile(spent_ms[name], 99))) for name, value in median.items()]
    print(f"1280x720, UR3, {VOXEL_M * 1e3:g} mm voxels, one thread, {rounds} rounds in turns")
    print("\n".join(table(("what", "median ms", "p99 ms"), rows)))
    share = float(np.mean([pipeline.foreground(frames.depth[n], frames.joints[n]).mean() for n in range(FRAMES)]))
    grid = costs_by_size()
    result: dict[str, Any] = {
        "process_ms": median["process"],
        "vs_open3d": median["open3d"] / median["process"],
        "vs_octomap": median["octomap"] / median["process"],
        "filter_vs_memcpy": filter_ms(frames.depth, frames.joints, pipeline, rounds) / median["memcpy"],
        "expected_depth_vs_embree": median["embree"] / median["robot layer"],
        "full_expected_depth_vs_embree": median["embree"] / median["expected depth"],
        "worst_case_ms": median["worst case"],
        "worst_case_vs_open3d": median["open3d, all points at 20 mm"] / median["worst case"],
        "foreground_share": share,
        "process_ms_by_size": grid,
    }
    ratio = max(costs["0.01"] / costs["0.05"] for costs in grid.values())
    marks = [
        Mark("process, times faster than Open3D", result["vs_open3d"], at_least=30.0),
        Mark("process, times faster than OctoMap", result["vs_octomap"], at_least=30.0),
        Mark("robot layer of a frame, times faster than Embree", result["expected_depth_vs_embree"], at_least=30.0),
        Mark("filter, in memcpys of two images", result["filter_vs_memcpy"], at_most=4.0),
        Mark("worst case, times faster than Open3D", result["worst_case_vs_open3d"], at_least=8.0),
        Mark("10 mm voxels, in costs of 50 mm", ratio, at_most=2.0),
    ]
    return result, marks


def filter_ms(depth: Any, joints: Any, pipeline: Any, rounds: int) -> float:
    """Median of the filter stage by itself, in ms: the robot stands still, so that nothing is drawn."""
    times = []
    for _ in range(rounds + 2):
        pipeline.foreground(depth[0], joints[0])
        began_ns = stage_ns()
        pipeline.foreground(depth[0], joints[0])
        times.append((stage_ns() - began_ns) / NS_PER_MS)
    return float(np.median(times[2:]))


def costs_by_size() -> dict[str, dict[str, float]]:
    """Milliseconds of `process` by resolution and voxel size, on the same frames."""
    grid: dict[str, dict[str, float]] = {}
    for width, height in RESOLUTIONS:
        frames = record(width, height, FRAMES)
        pipelines = {size: frames.pipeline(size) for size in VOXEL_SIZES_M}
        times: dict[float, list[float]] = {size: [] for size in VOXEL_SIZES_M}
        for turn in range(TABLE_ROUNDS + 2):
            n = turn % FRAMES
            for size, pipeline in pipelines.items():
                began_ns = stage_ns()
                pipeline.process(frames.depth[n], frames.joints[n])
                if turn >= 2:
                    times[size].append((stage_ns() - began_ns) / NS_PER_MS)
        grid[f"{width}x{height}"] = {str(size): float(np.median(spent)) for size, spent in times.items()}
    print("process(), median ms, by resolution and voxel size (m)")
    rows: list[tuple[str | float, ...]] = [(name, *costs.values()) for name, costs in grid.items()]
    print("\n".join(table(("resolution", *map(str, VOXEL_SIZES_M)), rows)))
    return grid


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make bench-pipeline", description="What a frame costs, beside its peers.")
    parser.add_argument("--rounds", type=int, default=40, help="in turns; the median counts")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="for pipeline.json")
    return parser


if __name__ == "__main__":
    sys.exit(main())
