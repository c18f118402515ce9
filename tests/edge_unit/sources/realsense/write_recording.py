# SPDX-License-Identifier: Apache-2.0
"""The process that writes a small recording: PATH FRAMES [NAME=VALUE ...]."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from edge_unit.sources.realsense.recorder import RecordedCamera, RecordedStream, SdkRecorder
from shared.clock import NS_PER_S, monotonic_ns
from tests.edge_unit.sources.realsense.recordings import (
    BASELINE_M,
    COLOR_AT_M,
    CX,
    CY,
    DEPTH_SCALE_M,
    FPS,
    FX,
    FY,
    HEIGHT,
    WIDTH,
    depth_of,
)


def main(path: str, frames: str, *options: str) -> None:
    """Write it at the pace of a camera, for at that pace it is played."""
    given: dict[str, Any] = dict(option.split("=") for option in options)
    width, height, fps = (
        int(given.get(name, usual)) for name, usual in (("width", WIDTH), ("height", HEIGHT), ("fps", FPS))
    )
    streams = [RecordedStream("depth", width, height, fps, FX, FY, CX, CY)]
    if given.get("images"):
        streams.append(RecordedStream("infrared", width, height, fps, FX, FY, CX, CY))
        streams.append(RecordedStream("color", width, height, fps, FX, FY, CX, CY, COLOR_AT_M))
    serial, usb = given.get("serial", "SYN0001"), given.get("usb", "3.2")
    camera = RecordedCamera(serial, "Synthetic D435", DEPTH_SCALE_M, BASELINE_M, "5.16.0.1", usb)
    recorder = SdkRecorder(Path(path), camera, streams)
    began_ns, pause = monotonic_ns(), Event()
    for number in range(1, int(frames) + 1):
        pause.wait(max(began_ns / NS_PER_S + number / fps - monotonic_ns() / NS_PER_S, 0.0))
        recorder.add("depth", depth_of(number, width, height), number, number * 1000.0 / fps)
        for each in streams[1:]:
            shape = (height, width, 3) if each.stream == "color" else (height, width)
            recorder.add(each.stream, np.full(shape, number, np.uint8), number, number * 1000.0 / fps)
    recorder.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
    sys.stdout.flush()
    # The SDK's destructors are known to abort.
    os._exit(0)
