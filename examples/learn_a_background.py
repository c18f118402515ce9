# SPDX-License-Identifier: Apache-2.0
"""Learn the empty cell, so that only what is new is reported: `python examples/learn_a_background.py`.

The simulated cell stands in a room of which there is no CAD. The background model learns it from frames without people.
"""

from __future__ import annotations

from pathlib import Path

from edge_unit.pipeline import DepthPipeline
from shared.cell import Cell
from shared.transforms import look_at
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics
from simulation.world.world import World

CELL = Path(__file__).parent.parent / "assets" / "cells" / "demo" / "cell.yaml"
FRAMES, FPS = 30, 15.0
"""Two seconds; for a real cell take ten."""


def main() -> None:
    """Print how much of the image is learned, and what one frame with a person shows afterwards."""
    cell = Cell.load(CELL)
    intrinsics = d435i_intrinsics(424, 240)
    T_world_camera = look_at(eye_m=(1.4, 0.0, 1.2), target_m=(0.0, 0.0, 0.2))
    empty = SimulatedCamera(World.demo(people=0, cell=cell), T_world_camera, intrinsics)
    walked = SimulatedCamera(World.demo(people=1, cell=cell), T_world_camera, intrinsics, seed=1)

    pipeline = DepthPipeline(intrinsics, T_world_camera, cell)
    frames = [empty.capture(n / FPS) for n in range(FRAMES)]
    reference = pipeline.learn((frame.depth, frame.joints) for frame in frames)
    pipeline.use(reference)  # reference.save(path) keeps it

    print(f"learned: {reference.learned_share:.0%} of the pixels from {FRAMES} frames")
    for name, frame in (("the empty cell", empty.capture(10.0)), ("a person walks", walked.capture(10.0))):
        voxels = pipeline.process(frame.depth, frame.joints).voxels
        print(f"{name}: {len(voxels.indices)} obstacle voxels")


if __name__ == "__main__":
    main()
