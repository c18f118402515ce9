# SPDX-License-Identifier: Apache-2.0
"""A process that writes a small recording for tests: `python write_recording.py PATH FRAMES [NAME=VALUE ...]`.

Frame n of depth is n everywhere but for its first row, which counts columns; infrared and colour are n.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_unit.sources.sdk_recorder import RecordedCamera, RecordedStream, SdkRecorder
from shared.clock import NS_PER_S, monotonic_ns

WIDTH, HEIGHT, FPS = 424, 240, 30


def depth_of(number: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint16]:
    """What frame `number` shows."""
    depth = np.full((height, width), number, np.uint16)
    depth[0] = np.arange(width)
    return depth


def main(path: str, frames: str, *options: str) -> None:
    """Write it."""
    given: dict[str, Any] = dict(option.split("=") for option in options)
    width, height = int(given.get("width", WIDTH)), int(given.get("height", HEIGHT))
    fps = int(given.get("fps", FPS))
    lens = (fps, 212.5, 211.5, width / 2 + 0.25, height / 2 - 0.25)
    streams = [RecordedStream("depth", width, height, *lens)]
    if given.get("images"):
        streams.append(RecordedStream("infrared", width, height, *lens))
        streams.append(RecordedStream("color", width, height, *lens, stands_at_m=(0.015, 0.0, 0.001)))
    camera = RecordedCamera(
        given.get("serial", "SYN0001"), "Synthetic D435", 0.0005, 0.055, "5.16.0.1", given.get("usb", "3.2")
    )
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
    os._exit(0)
