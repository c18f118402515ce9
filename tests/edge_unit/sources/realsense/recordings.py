# SPDX-License-Identifier: Apache-2.0
"""Small recordings for tests. The SDK writes them in a process of its own, this module never loads it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.missing import missing

WIDTH, HEIGHT, FPS = 424, 240, 30
DEPTH_SCALE_M, BASELINE_M = 0.0005, 0.055
FX, FY, CX, CY = 212.5, 211.5, WIDTH / 2 + 0.25, HEIGHT / 2 - 0.25
COLOR_AT_M = (0.015, 0.0, 0.001)
"""Place of the colour camera in the depth camera's frame; the infrared imager is at the origin of depth."""


def depth_of(number: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint16]:
    """Depth image of frame `number`: its number everywhere, but a first row that counts columns."""
    depth = np.full((height, width), number, np.uint16)
    depth[0] = np.arange(width)
    return depth


def write(path: Path, frames: int, **options: object) -> Path:
    """Write a recording; options: width, height, fps, images (infrared and colour too), serial, usb.

    Skips the test where the SDK cannot be imported; in CI that fails.
    """
    module = "tests.edge_unit.sources.realsense.write_recording"
    command = [sys.executable, "-m", module, str(path), str(frames), *(f"{name}={v}" for name, v in options.items())]
    ended = subprocess.run(command, capture_output=True, text=True)
    if "ImportError" in ended.stderr or "ModuleNotFoundError: No module named 'pyrealsense2'" in ended.stderr:
        missing(f"pyrealsense2 cannot be imported: {ended.stderr.strip().splitlines()[-1]}")
    assert ended.returncode == 0, ended.stderr
    return path
