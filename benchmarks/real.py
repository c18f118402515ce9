# SPDX-License-Identifier: Apache-2.0
"""`make real`: run a real master and a real unit on recorded frames of a real cell, judged frame by frame.

The unit plays the recording. It learns the background model from the frames of the empty cell, then watches the frames
in which a second robot stands. The merged map must hold the second robot, and nothing of the known robot. The run is
done twice: from the images as they are, and from an SDK recording of them through the RealSense source.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import yaml
from numpy.typing import NDArray

from benchmarks import real_frames
from benchmarks.real_frames import EMPTY_FRAMES, WATCHED_FRAMES, FrameMarks, RealFrames
from benchmarks.reporting.report import RESULTS, Mark, Result, line, write
from edge_unit.config import ENVIRONMENT_PREFIX as UNIT_PREFIX
from edge_unit.config import SourceConfig
from edge_unit.monitoring import read_trace
from edge_unit.pipeline import DepthPipeline
from edge_unit.sources.realsense.bag_writer import record_images
from edge_unit.sources.realsense.source import RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSourceConfig, open_recording
from master_server.config import ENVIRONMENT_PREFIX as MASTER_PREFIX
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, SourceError
from shared.waiting import within
from simulation.fleet.processes import Child, Processes
from simulation.fleet.running_master import RunningMaster, start_master

READY_S = 60.0
"""Time limit for a process to start and compile its kernels on a slow machine."""

FRAME_S = 1.0
"""Duration of each frame: long enough to read the map that it made."""

POLL_S = 0.05

LEAK_PERCENT_MAX = 0.3
MISS_PERCENT_MAX = 2.5
SECOND_ROBOT_VOXELS_MIN = 90.0

PICTURE_DEPTH_M = 4.0
"""Depth with the last colour of the scale."""

ORDER = [*EMPTY_FRAMES, *WATCHED_FRAMES]
"""Order of the recording: first the frames for learning, then those for watching."""


@dataclass(frozen=True, eq=False)
class SeenMap:
    """The merged map of one frame, and its cost to the unit."""

    keys: NDArray[np.uint32]
    process_ms: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run both recordings and print one JSON line last. The exit code is 1 when a mark is missed."""
    options = _parser().parse_args(arguments)
    try:
        folder = real_frames.find()
        cell = real_frames.cell(folder)
        images = _images(folder)
        info = open_recording(images)
        assert info.T_world_camera is not None
        pipeline = DepthPipeline(info.intrinsics, info.T_world_camera, cell, real_frames.default_settings())
        frames = real_frames.load(folder, pipeline)
        print("playing the images ...", flush=True)
        maps = asyncio.run(play(folder, images))
        print("writing the images as an SDK recording, and playing it ...", flush=True)
        recorded = asyncio.run(play_recording(folder, images))
    except CellwatchError as error:
        print(f"make real: {error}", file=sys.stderr)
        return 1
    result = judge(frames, maps, recorded, options.out)
    write("real", result, options.results)
    print(line(result))
    return 0 if result["passed"] else 1


async def play_recording(folder: Path, images: RecordedSourceConfig) -> dict[int, SeenMap]:
    """Play the same frames as an SDK recording, through the RealSense source."""
    with tempfile.TemporaryDirectory(prefix="cellwatch-recording-") as scratch:
        recording, joints_file = Path(scratch) / "frames.db3", Path(scratch) / "joints.csv"
        await asyncio.to_thread(record_images, images.model_copy(update={"fps": None}), recording)
        joints = np.loadtxt(folder / "joint_states_rad.csv", delimiter=",")
        np.savetxt(joints_file, joints[ORDER], delimiter=",", fmt="%.12f")
        # Frame by frame: at its own pace the recording would be over before the unit has its cell.
        source = RealsenseSourceConfig(
            recording=recording, joints_file=joints_file, fx_stereo=real_frames.STEREO_FOCAL_PX, real_time=False
        )
        return await play(folder, source)


async def play(folder: Path, source: SourceConfig) -> dict[int, SeenMap]:
    """Run a real unit that plays the frames and a real master. Return the map of each watched frame.

    For images, which are played slowly, it is the merged map. For a recording it is the unit's report, and the merged
    map of the last frame.
    """
    with tempfile.TemporaryDirectory(prefix="cellwatch-real-") as scratch:
        state = Path(scratch)
        async with Processes(state / "logs", without=(UNIT_PREFIX, MASTER_PREFIX)) as processes:
            master = await start_master(
                processes, real_frames.CELL, state / "master", "--set", "settings.stale_after_s=5.0", ready_s=READY_S
            )
            unit = await _start_unit(processes, state, master, folder, source)
            async with httpx.AsyncClient(base_url=master.url, headers=master.as_operator) as client:
                if isinstance(source, RealsenseSourceConfig):
                    if not await within(READY_S, unit.process.wait()):
                        raise SourceError(f"the unit did not play the recording to its end; {unit.log_tail()}")
                    last = WATCHED_FRAMES[-1]
                    maps = {last: SeenMap(await _voxels(client), 0.0)}
                else:
                    maps = await _watch(client, unit)
        first = 1 if isinstance(source, RealsenseSourceConfig) else 0
        reported: dict[int, SeenMap] = {}
        for record in read_trace(state / "trace.msgpack"):
            frame = ORDER[record.frame_number - first]
            keys = np.frombuffer(record.keys, "<u4")
            reported[frame] = SeenMap(keys, record.process_ms)
            if frame in maps and not np.array_equal(keys, maps[frame].keys):
                raise SourceError(f"frame {frame}: the merged map is not what the only unit reported")
    if missing := set(WATCHED_FRAMES) - set(reported):
        raise SourceError(f"the unit did not report frames {sorted(missing)}; {unit.log_tail()}")
    return {frame: maps.get(frame, reported[frame]) if first == 0 else reported[frame] for frame in WATCHED_FRAMES}


def judge(frames: RealFrames, maps: dict[int, SeenMap], recorded: dict[int, SeenMap], out: Path) -> dict[str, Any]:
    """Print the figures of each frame, draw its plot, and sum up."""
    out.mkdir(parents=True, exist_ok=True)
    judged: list[FrameMarks] = []
    rows: list[tuple[str | float, ...]] = []
    same = True
    for frame in WATCHED_FRAMES:
        seen = maps[frame]
        found = frames.pipeline.process(frames.depth[frame], frames.joints[frame]).voxels
        same &= np.array_equal(found.keys, seen.keys)
        judged.append(frames.marks(frame, seen.keys))
        picture = out / f"frame{frame}.png"
        cv2.imwrite(str(picture), draw(frames, frame, seen.keys))
        each = judged[-1]
        shares = (each.robot_leak_percent, each.second_robot_miss_percent)
        counts = (each.second_robot_voxels, each.false_voxels)
        rows.append((f"frame {frame}", *shares, *counts, seen.process_ms, recorded[frame].process_ms))
    equal = all(np.array_equal(maps[frame].keys, recorded[frame].keys) for frame in WATCHED_FRAMES)
    leak = max(each.robot_leak_percent for each in judged)
    miss = max(each.second_robot_miss_percent for each in judged)
    voxels = min(each.second_robot_voxels for each in judged)
    false = max(each.false_voxels for each in judged)
    marks = (
        Mark("robot pixels reported, % of a frame's, worst frame", leak, at_most=LEAK_PERCENT_MAX),
        Mark("second robot's pixels not reported, %, worst frame", miss, at_most=MISS_PERCENT_MAX),
        Mark("voxels of the second robot, fewest", float(voxels), at_least=SECOND_ROBOT_VOXELS_MIN),
        Mark("false voxels, most", float(false), at_most=0.0),
        Mark("the merged map is what the pipeline finds", float(same), at_least=1.0),
        Mark("an SDK recording gives what the images give", float(equal), at_least=1.0),
    )
    result = Result(
        "Recorded frames of a real robot, margins at their defaults",
        ("frame", "leak %", "missed %", "second robot, voxels", "false", "ms, images", "ms, recording"),
        tuple(rows),
        marks,
    )
    print(result)
    return result.document() | {
        "robot_leak_percent_max": round(leak, 3),
        "second_robot_miss_percent_max": round(miss, 2),
        "second_robot_voxels_min": voxels,
        "false_voxels_max": false,
        "frames": len(judged),
        "map_equals_pipeline": same,
        "recording_equals_images": equal,
        "process_ms_max": round(max(seen.process_ms for seen in maps.values()), 2),
        "recording_process_ms_max": round(max(seen.process_ms for seen in recorded.values()), 2),
        "pictures": str(out),
        "passed": all(mark.met for mark in marks),
    }


def draw(frames: RealFrames, frame: int, keys: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Draw four panels in one image: depth, expected depth, surviving pixels on colour, voxels on colour."""
    depth, joints = frames.depth[frame], frames.joints[frame]
    scale_m = frames.pipeline.intrinsics.depth_scale_m
    measured = _coloured(depth * scale_m)
    expected = _coloured(frames.pipeline.expected_depth(joints))
    surviving = frames.colour[frame].copy()
    surviving[frames.pipeline.foreground(depth, joints)] = (0, 255, 0)
    boxes = frames.colour[frame].copy()
    half_m = 0.5 * frames.pipeline.lattice.voxel_size_m
    columns, rows, depths_m = frames.project(keys)
    for u, v, z in sorted(zip(columns, rows, depths_m, strict=True), key=lambda voxel: -voxel[2]):
        half_px = half_m * frames.pipeline.intrinsics.fx / z
        corner, opposite = (round(u - half_px), round(v - half_px)), (round(u + half_px), round(v + half_px))
        cv2.rectangle(boxes, corner, opposite, (0, 200, 255), -1)
        cv2.rectangle(boxes, corner, opposite, (0, 60, 120), 2)
    rows_of = [np.hstack((measured, expected)), np.hstack((surviving, boxes))]
    return np.asarray(cv2.resize(np.vstack(rows_of), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)


def _coloured(depth_m: NDArray[Any]) -> NDArray[np.uint8]:
    """Colour a depth image: near is warm, far is cold, black is unknown."""
    known = np.isfinite(depth_m) & (depth_m > 0.0)
    share = np.where(known, 1.0 - np.clip(np.where(known, depth_m, 0.0) / PICTURE_DEPTH_M, 0.0, 1.0), 0.0)
    image = np.array(cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_TURBO), np.uint8)
    image[~known] = 0
    return image


async def _watch(client: httpx.AsyncClient, unit: Child) -> dict[int, SeenMap]:
    """Poll the merged map until there is one of each watched frame."""
    maps: dict[int, SeenMap] = {}
    deadline_ns = monotonic_ns() + round((READY_S + len(ORDER) * FRAME_S) * NS_PER_S)
    while set(maps) != set(WATCHED_FRAMES):
        if monotonic_ns() > deadline_ns or unit.failed:
            raise SourceError(f"the unit did not report all frames, only {sorted(maps)}; {unit.log_tail()}")
        before = await _row(client)
        keys = await _voxels(client)
        after = await _row(client)
        if before is not None and after is not None and before["health"]["frame"] == after["health"]["frame"]:
            frame = ORDER[after["health"]["frame"]]
            if after["state"] == "live" and after["health"]["trouble"] is None and frame in WATCHED_FRAMES:
                maps[frame] = SeenMap(keys, float(after["process_ms"]))
        await asyncio.sleep(POLL_S)
    return maps


async def _voxels(client: httpx.AsyncClient) -> NDArray[np.uint32]:
    """Return the keys (N,) of the merged map."""
    answer = (await client.get("/voxels", params={"form": "keys"})).raise_for_status().json()
    return np.array(answer["voxels"], np.uint32)


async def _row(client: httpx.AsyncClient) -> dict[str, Any] | None:
    """Return the row of the only unit, or None."""
    units = (await client.get("/units")).raise_for_status().json()
    rows: list[dict[str, Any]] = units["units"] if isinstance(units, dict) else units
    return rows[0] if rows else None


async def _start_unit(
    processes: Processes, state: Path, master: RunningMaster, folder: Path, source: SourceConfig
) -> Child:
    """Start a real unit that learns from the first frames and watches the others."""
    config = {
        "master_url": master.url,
        "token_file": str(master.unit_token_file),
        "state_dir": str(state / "unit"),
        "source": source.model_dump(mode="json"),
        "T_world_camera": {"file": str(folder / "T_base_optical.txt")},
        "learn_background_frames": len(EMPTY_FRAMES),
        "trace_path": str(state / "trace.msgpack"),
    }
    path = state / "unit.yaml"
    path.write_text(yaml.safe_dump(config))
    return await processes.start("unit", "edge_unit", "run", str(path), may_end=True)


def _images(folder: Path) -> RecordedSourceConfig:
    return RecordedSourceConfig(
        folder=folder, frames=tuple(ORDER), fps=1.0 / FRAME_S, fx_stereo=real_frames.STEREO_FOCAL_PX
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="make real", description="Run the filter on real frames, end to end.")
    parser.add_argument("--out", type=Path, default=Path("out/real"), metavar="DIR", help="folder for the plots")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="folder for real.json")
    return parser


if __name__ == "__main__":
    sys.exit(main())
