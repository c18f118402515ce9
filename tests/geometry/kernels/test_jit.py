# SPDX-License-Identifier: Apache-2.0
"""Separate processes: a service without a writable folder works, and one with cached kernels starts fast."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.edge_unit.scenes import CHECKOUT

FIRST_FRAME = """
import logging, time
started_s = time.clock_gettime(time.CLOCK_MONOTONIC)
logging.basicConfig(level=logging.WARNING, format="%(message)s")
import numpy as np
from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.transforms import look_at
pipeline = DepthPipeline(
    Intrinsics(424, 240, 213.7, 213.7, 211.5, 119.5),
    look_at((1.3, 0.7, 1.0), (0.2, 0.0, 0.25)),
    Cell.load("assets/cells/demo/cell.yaml"),
)
depth = np.full((240, 424), 700, np.uint16)
voxels = pipeline.process(depth, np.zeros(6)).voxels
print(len(voxels), time.clock_gettime(time.CLOCK_MONOTONIC) - started_s)
"""


def first_frame(**variables: str) -> tuple[int, float, str]:
    """Return the voxels, the seconds from the start to the first frame, and the log."""
    done = subprocess.run(
        [sys.executable, "-c", FIRST_FRAME],
        cwd=CHECKOUT,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    number, seconds = done.stdout.split()
    return int(number), float(seconds), done.stderr.strip()


@pytest.mark.slow
def test_without_a_writable_folder_it_works_with_a_warning(tmp_path: Path) -> None:
    """The tests may run as root, which can write everywhere except below a file."""
    (tmp_path / "file").write_text("")
    below = str(tmp_path / "file" / "below")
    variables = {"HOME": below, "XDG_CACHE_HOME": below, "NUMBA_CACHE_DIR": below, "TMPDIR": str(tmp_path)}
    variables["CELLWATCH_JIT_CACHE"] = below
    number, seconds, logged = first_frame(**variables)
    print(f"cold: first frame after {seconds:.1f} s")
    assert number > 100
    assert below in logged
    assert "CELLWATCH_JIT_CACHE" in logged
    assert logged.count("\n") == 0


@pytest.mark.slow
def test_the_first_frame_is_fast_with_cached_kernels(tmp_path: Path) -> None:
    kept = str(tmp_path / "kernels")
    number, cold_s, _ = first_frame(CELLWATCH_JIT_CACHE=kept)
    again, warm_s, logged = first_frame(CELLWATCH_JIT_CACHE=kept)
    print(f"first frame after {cold_s:.1f} s with an empty cache, after {warm_s:.2f} s with a warm one")
    assert again == number > 100
    assert logged == ""
    # 3 s is the aim on an idle machine; this one may be busy with other tests.
    assert warm_s <= 6.0
