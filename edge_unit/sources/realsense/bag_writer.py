# SPDX-License-Identifier: Apache-2.0
"""Converts a folder of depth images to a recording of the RealSense SDK: `edge-unit record-images DIR OUT.db3`.

Played through the `realsense` source it gives the same depth, bit for bit, with the same intrinsics and depth scale. A
recording carries no joints; they are written to a file beside it, OUT.joints.csv, for the source's `joints_file`.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event

import numpy as np

from edge_unit.sources.realsense.source import RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from shared.clock import NS_PER_S, monotonic_ns
from shared.errors import CellwatchError, SourceError

DEFAULT_FPS = 15.0
"""A recording plays at the rate at which it was written, so it is written at a camera's rate."""


def record_images(images: RecordedSourceConfig, path: Path, fps: float = DEFAULT_FPS) -> int:
    """Write the images to `path` (.db3), at `fps` frames a second; returns their number.

    Joints of the images go to `joints_path(path)`. A separate process does the work, so that the SDK cannot harm this
    one.

    Raises:
        SourceError: an image cannot be read, or the recording cannot be written; the text names the file.
    """
    command = (
        sys.executable,
        "-m",
        "edge_unit.sources.realsense.bag_writer",
        images.model_dump_json(),
        str(path),
        str(fps),
    )
    ended = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if ended.returncode:
        lines = ended.stderr.strip().splitlines()
        raise SourceError(lines[-1] if lines else f"{path}: the recorder ended with status {ended.returncode}")
    return int(ended.stdout)


def joints_path(recording: Path) -> Path:
    """Return the file of a recording's joints: row i belongs to frame number i + 1."""
    return recording.with_suffix(".joints.csv")


def played(images: RecordedSourceConfig, recording: Path) -> RealsenseSourceConfig:
    """Return the source that plays `recording` of `record_images`: each frame once, in the order of `images`."""
    joints = joints_path(recording)
    return RealsenseSourceConfig(
        recording=recording,
        real_time=False,
        joints_file=joints if joints.is_file() else None,
        fx_stereo=images.fx_stereo,
    )


async def _record(images: RecordedSourceConfig, path: Path, fps: float) -> int:
    from edge_unit.sources.realsense.recorder import RecordedCamera, RecordedStream, SdkRecorder

    source = RecordedSource(images)
    info = await source.open()
    lens = info.intrinsics
    recorder = SdkRecorder(
        path,
        RecordedCamera(info.serial, info.model, lens.depth_scale_m, lens.stereo_baseline_m),
        [RecordedStream("depth", lens.width, lens.height, round(fps), lens.fx, lens.fy, lens.cx, lens.cy)],
    )
    count, joints, began_ns, pause = 0, [], monotonic_ns(), Event()
    try:
        async for frame in source.frames():
            pause.wait(max(began_ns + count * NS_PER_S / fps - monotonic_ns(), 0.0) / NS_PER_S)
            count += 1
            recorder.add("depth", frame.depth, count, count * 1000.0 / fps)
            if frame.joints is not None:
                joints.append(frame.joints)
        recorder.close()
    except SourceError:
        path.unlink(missing_ok=True)
        raise
    joints_path(path).unlink(missing_ok=True)
    if joints:
        np.savetxt(joints_path(path), joints, fmt="%.17g", delimiter=",")
    return count


def main(arguments: Sequence[str]) -> int:
    """Run the recording process: a source configuration as JSON, the file, and the rate."""
    images, path, fps = arguments
    try:
        count = asyncio.run(_record(RecordedSourceConfig.model_validate_json(images), Path(path), float(fps)))
    except CellwatchError as error:
        print(error, file=sys.stderr)
        return 1
    print(count)
    return 0


if __name__ == "__main__":
    status = main(sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    # The SDK's destructors are known to abort.
    os._exit(status)
