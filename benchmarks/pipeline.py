# SPDX-License-Identifier: Apache-2.0
"""`make bench-pipeline`: measure the cost of a frame beside Open3D, OctoMap, Embree and a memcpy on the same frames.

All contenders use one thread and take turns of a few frames, so other load on the machine affects all of them. Figures
are medians over all frames; ratios are ratios of medians. The first frame of a turn is also listed by itself: its
caches were filled by other contenders, as other programs of a board fill them between two frames of a camera.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.ur3_scene import Recording, record
from benchmarks.reporting.report import RESULTS, Mark, Result, line, write
from edge_unit.pipeline import DepthPipeline
from shared.clock import NS_PER_MS, stage_ns
from shared.errors import CellwatchError

VOXEL_M = 0.02
WORST_VOXEL_M = 0.01
VOXEL_SIZES_M = (0.01, 0.02, 0.03, 0.05, 0.1)
RESOLUTIONS = ((424, 240), (640, 480), (848, 480), (1280, 720))
SIZE = (1280, 720)
FRAMES = 8
FRAMES_A_TURN = 3
TABLE_TURNS = 8

ARBITRARY_RAW = (300, 2500)
"""Each pixel of the worst frame has a random depth of this range. No frame touches more voxels."""

DUFOMAP = "DUFOMap, the same points"

VOXELS = "process(), as far as the voxels"
"""Peers compute neither seen nor health, so they are compared with this part only."""

Work = Callable[[int], object]
"""Takes the number of a frame. Returns a `Part` if only that part of the work counts."""


@dataclass(frozen=True)
class Part:
    """Duration of a part of some work in nanoseconds."""

    took_ns: int


class Spent:
    """Milliseconds of the frames of one contender, turn by turn."""

    def __init__(self) -> None:
        self.turns: list[list[float]] = []

    @property
    def median(self) -> float:
        """Return the median over all frames."""
        return float(np.median(self.turns))

    @property
    def p99(self) -> float:
        """Return the 99th percentile over all frames."""
        return float(np.percentile(self.turns, 99))

    @property
    def first(self) -> float:
        """Return the median of the first frames of the turns. Their caches were filled by other contenders."""
        return float(np.median([turn[0] for turn in self.turns]))


def in_turns(contenders: Mapping[str, Work], turns: int, frames: int = FRAMES) -> dict[str, Spent]:
    """Run a few frames of each contender in turn. The first round compiles and does not count."""
    spent = {name: Spent() for name in contenders}
    for turn in range(turns + 1):
        for name, work in contenders.items():
            took_ms = []
            for k in range(FRAMES_A_TURN):
                began_ns = stage_ns()
                found = work((turn * FRAMES_A_TURN + k) % frames)
                took_ns = found.took_ns if isinstance(found, Part) else stage_ns() - began_ns
                took_ms.append(took_ns / NS_PER_MS)
            if turn > 0:
                spent[name].turns.append(took_ms)
    return spent


def contenders_of(frames: Recording) -> dict[str, Work]:
    """Return our variants and the peers by name. Each takes the number of a frame."""
    from benchmarks.peers import contenders as peers

    pipeline, still = frames.pipeline(VOXEL_M), frames.pipeline(VOXEL_M)
    unknowing = frames.pipeline_that_knows_nothing(WORST_VOXEL_M)
    depth, joints, surface = frames.depth, frames.joints, frames.unhindered
    arbitrary = np.random.default_rng(0).integers(*ARBITRARY_RAW, depth.shape).astype(np.uint16)
    camera = peers.Camera(frames.intrinsics, frames.T_world_camera, frames.cell)
    open3d, embree = peers.Open3D(camera, pipeline.settings), peers.Embree(camera)
    octomap, discrete = peers.OctoMap(camera, VOXEL_M), peers.OctoMap(camera, VOXEL_M)
    # DUFOMap is built for a smaller set of processors than the others.
    dufomap = peers.DUFOMap(camera, VOXEL_M) if importlib.util.find_spec("dufomap") else None
    marked = [pipeline.foreground(depth[n], joints[n]) for n in range(len(depth))]
    points_m = [camera.points_m(depth[n], marked[n]) for n in range(len(depth))]
    everything = np.ones(frames.intrinsics.shape, np.bool_)
    copies = np.zeros((2, *frames.intrinsics.shape), np.uint16)

    def copy_two_images(n: int) -> None:
        np.copyto(copies[0], depth[n])
        np.copyto(copies[1], surface[n])

    return {
        "process()": lambda n: pipeline.process(depth[n], joints[n]),
        VOXELS: _to_voxels(pipeline, depth, joints),
        "Open3D, the same work": lambda n: open3d.process(depth[n], joints[n], VOXEL_M),
        "OctoMap, the same points": lambda n: octomap.insert(points_m[n]),
        "OctoMap, a ray for each voxel hit": lambda n: discrete.insert(points_m[n], once=True),
        **({DUFOMAP: lambda n: dufomap.insert(points_m[n])} if dufomap else {}),
        "expected_depth()": lambda n: pipeline.expected_depth(joints[n]),
        "Embree, the same picture": lambda n: embree.expected_depth(joints[n]),
        "Embree, the robot alone": lambda n: embree.robot_depth(joints[n]),
        "Embree, link by link": lambda n: embree.robot_depth_link_by_link(joints[n]),
        "filter": lambda n: still.foreground(depth[n], joints[0]),
        "memcpy of two images": copy_two_images,
        "all foreground, arbitrary depths": _to_voxels(unknowing, arbitrary),
        "Open3D, arbitrary depths at 20 mm": lambda n: open3d.voxels(arbitrary[n], everything, VOXEL_M),
        "all foreground, the room's surfaces": _to_voxels(unknowing, surface),
        "Open3D, the room's surfaces at 20 mm": lambda n: open3d.voxels(surface[n], everything, VOXEL_M),
    }


def compare(frames: Recording, turns: int) -> tuple[dict[str, Any], list[Mark]]:
    """Compare the cost of a frame with the peers. Return the figures by name, and their marks."""
    from benchmarks.peers.contenders import PEERS

    spent = in_turns(contenders_of(frames), turns, len(frames.depth))
    result = Result(
        f"{SIZE[0]}x{SIZE[1]}, UR3, {VOXEL_M * 1e3:g} mm voxels, one thread, {turns} turns of {FRAMES_A_TURN} frames",
        ("what", "median ms", "p99 ms", "first of a turn, ms"),
        tuple((name, each.median, each.p99, each.first) for name, each in spent.items()),
        remarks=tuple(f"{name}: {what}" for name, what in PEERS.items()),
    )
    print(result, flush=True)

    def times(theirs: str, ours: str) -> float:
        return spent[theirs].median / spent[ours].median

    def times_at_first(theirs: str, ours: str) -> float:
        return spent[theirs].first / spent[ours].first

    pipeline = frames.pipeline(VOXEL_M)
    share = [
        pipeline.foreground(depth, joints).mean() for depth, joints in zip(frames.depth, frames.joints, strict=True)
    ]
    arbitrary, surface = "all foreground, arbitrary depths", "all foreground, the room's surfaces"
    figures: dict[str, Any] = {
        "process_ms": spent["process()"].median,
        "process_p99_ms": spent["process()"].p99,
        "process_cold_ms": spent["process()"].first,
        "voxels_ms": spent[VOXELS].median,
        "whole_frame_vs_open3d": times("Open3D, the same work", "process()"),
        "foreground_share": float(np.mean(share)),
        "vs_open3d": times("Open3D, the same work", VOXELS),
        "vs_open3d_cold": times_at_first("Open3D, the same work", VOXELS),
        "vs_octomap": times("OctoMap, the same points", VOXELS),
        "vs_octomap_cold": times_at_first("OctoMap, the same points", VOXELS),
        "vs_octomap_discrete": times("OctoMap, a ray for each voxel hit", VOXELS),
        **({"vs_dufomap": times(DUFOMAP, VOXELS)} if DUFOMAP in spent else {}),
        "filter_vs_memcpy": spent["filter"].median / spent["memcpy of two images"].median,
        "expected_depth_ms": spent["expected_depth()"].median,
        "expected_depth_vs_embree": times("Embree, the same picture", "expected_depth()"),
        "expected_depth_vs_embree_robot_alone": times("Embree, the robot alone", "expected_depth()"),
        "expected_depth_vs_embree_link_by_link": times("Embree, link by link", "expected_depth()"),
        "worst_case_ms": spent[arbitrary].median,
        "worst_case_vs_open3d": times("Open3D, arbitrary depths at 20 mm", arbitrary),
        "worst_case_vs_open3d_cold": times_at_first("Open3D, arbitrary depths at 20 mm", arbitrary),
        "surfaces_ms": spent[surface].median,
        "surfaces_vs_open3d": times("Open3D, the room's surfaces at 20 mm", surface),
        "seen_and_health_ms": spent["process()"].median - spent[VOXELS].median,
        "spent_ms": {n: {"median": s.median, "p99": s.p99, "first": s.first} for n, s in spent.items()},
        "contenders": result.document(),
    }
    marks = [
        Mark("frame to voxels, times faster than Open3D", figures["vs_open3d"], at_least=30.0),
        Mark("frame to voxels, times faster than OctoMap", figures["vs_octomap"], at_least=30.0),
        Mark("expected depth, times faster than Embree", figures["expected_depth_vs_embree"], at_least=30.0),
        Mark("filter, in memcpys of two images", figures["filter_vs_memcpy"], at_most=4.0),
        Mark("worst case, times faster than Open3D", figures["worst_case_vs_open3d"], at_least=8.0),
    ]
    return figures, marks


def costs_by_size(recordings: Sequence[Recording], turns: int) -> tuple[dict[str, Any], list[Mark]]:
    """Return the milliseconds from frame to voxels by resolution and voxel size, on the same frames."""
    costs: dict[str, dict[str, float]] = {}
    for frames in recordings:
        pipelines = {f"{size * 1e3:g} mm": frames.pipeline(size) for size in VOXEL_SIZES_M}
        spent = in_turns(
            {name: _to_voxels(each, frames.depth, frames.joints) for name, each in pipelines.items()},
            turns,
            len(frames.depth),
        )
        size = f"{frames.intrinsics.width}x{frames.intrinsics.height}"
        costs[size] = {name: each.median for name, each in spent.items()}
    result = Result(
        "frame to voxels, median ms by resolution and voxel size, 10 % of the pixels foreground",
        ("resolution", *next(iter(costs.values()))),
        tuple((name, *each.values()) for name, each in costs.items()),
    )
    print(result, flush=True)
    ratio = max(each["10 mm"] / each["50 mm"] for each in costs.values())
    return {"process_ms_by_size": costs, "sizes": result.document()}, [
        Mark("10 mm voxels, in costs of 50 mm", ratio, at_most=2.0)
    ]


def _to_voxels(pipeline: DepthPipeline, depth: NDArray[np.uint16], joints: NDArray[np.float64] | None = None) -> Work:
    """Run the stages that peers have, too: expected depth, foreground, voxels, density."""

    def work(n: int) -> Part:
        times = pipeline.process(depth[n], None if joints is None else joints[n]).times
        return Part(times.expected_ns + times.foreground_ns + times.density_ns)

    return work


def single_thread() -> None:
    """Restrict the peers to one thread, as ours. It must run before they are imported."""
    os.environ.update(OMP_NUM_THREADS="1", TBB_NUM_THREADS="1")
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the tables, and all of it as one line of JSON. Exit code 1 when a mark is missed."""
    options = _parser().parse_args(arguments)
    single_thread()
    try:
        frames = record(*SIZE, FRAMES)
        figures, marks = compare(frames, options.turns)
        others = [record(*size, FRAMES) for size in RESOLUTIONS if size != SIZE]
        sizes, more = costs_by_size([*others, frames], min(options.turns, TABLE_TURNS))
    except (CellwatchError, ImportError) as error:
        print(f"make bench-pipeline: {error}", file=sys.stderr)
        return 1
    marks += more
    print("\n".join(map(str, marks)))
    document = figures | sizes | {"marks": [mark.document() for mark in marks]}
    document["passed"] = all(mark.met for mark in marks)
    write("pipeline", document, options.results)
    print(line(document))
    return 0 if document["passed"] else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make bench-pipeline", description="Measure the cost of a frame beside its peers."
    )
    parser.add_argument(
        "--turns", type=int, default=25, help=f"turns of {FRAMES_A_TURN} frames each; the median counts (25)"
    )
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="folder for pipeline.json")
    return parser


if __name__ == "__main__":
    sys.exit(main())
