# SPDX-License-Identifier: Apache-2.0
"""Compiles all kernels of a simulated unit into the cache, so that many units do not compile them at the same time.

`python -m simulation.fleet.warm_up` takes a minute the first time, and a few seconds if all kernels are compiled.
"""

from __future__ import annotations

import numpy as np

from edge_unit.pipeline import DepthPipeline
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.cameras.truth import TruthFinder
from simulation.world.world import World


def warm_up() -> None:
    """Run each stage once. Kernels are compiled for types, not for sizes, so any resolution serves."""
    world = World.demo()
    intrinsics = d435i_intrinsics(424, 240)
    pose = rig(world.cell)[0]
    pipeline = DepthPipeline(intrinsics, pose, world.cell)
    camera = SimulatedCamera(world, pose, intrinsics)
    finder = TruthFinder(intrinsics, pose, pipeline.lattice, camera.noise)
    frame = camera.capture(0.0)
    finder.find(frame.view)
    pipeline.process(np.zeros(intrinsics.shape, np.uint16), frame.joints)
    pipeline.process(frame.depth, frame.joints)


if __name__ == "__main__":
    warm_up()
