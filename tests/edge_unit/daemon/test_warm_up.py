# SPDX-License-Identifier: Apache-2.0
"""The warm-up compiles all that the first frame needs."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys

import numpy as np
from numba.core.dispatcher import Dispatcher

from edge_unit.daemon.warm_up import warm_up_kernels
from edge_unit.pipeline import DepthPipeline
from geometry import kernels
from shared.transforms import look_at
from tests.edge_unit.scenes import camera, demo_cell


def compiled() -> dict[str, int]:
    """Return the number of types that each kernel is compiled for."""
    return {
        f"{module.name}.{name}": len(value.signatures)
        for module in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}.")
        for name, value in vars(importlib.import_module(module.name)).items()
        if isinstance(value, Dispatcher)
    }


def first_frame() -> None:
    """Return the first frame of the demo cell, with its robot."""
    cell = demo_cell()
    pipeline = DepthPipeline(camera(), look_at((2.0, 0.0, 1.5), (0.0, 0.0, 0.0)), cell)
    assert cell.robot is not None
    pipeline.process(np.full((240, 424), 1500, np.uint16), np.zeros(cell.robot.joint_count))


def test_the_first_frame_needs_no_kernel_that_was_not_rehearsed() -> None:
    # In a process of its own, as other tests use kernels too.
    subprocess.run([sys.executable, "-m", "tests.edge_unit.daemon.test_warm_up"], check=True, timeout=110)


def test_no_reader_of_meshes_is_imported_for_it() -> None:
    # Half a second, which would be half of a start.
    code = (
        "import sys; from edge_unit.daemon.warm_up import warm_up_kernels; warm_up_kernels(); "
        "sys.exit('trimesh' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=110)


if __name__ == "__main__":
    warm_up_kernels()
    ready = compiled()
    assert sum(count > 0 for count in ready.values()) > 10, ready
    first_frame()
    late = {name for name, count in compiled().items() if count > ready[name]}
    assert not late, late
