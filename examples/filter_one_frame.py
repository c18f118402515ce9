# SPDX-License-Identifier: Apache-2.0
"""Filter one depth frame with the library: `python examples/filter_one_frame.py`.

The frame comes from a simulated camera. Replace `depth` and `joints` by those of a camera and a robot.
"""

from __future__ import annotations

from pathlib import Path

from edge_unit.pipeline import DepthPipeline
from shared.cell import Cell
from shared.transforms import look_at
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics
from simulation.world.world import World

CELL = Path(__file__).parent.parent / "assets" / "cells" / "demo" / "cell.yaml"


def main() -> None:
    """Print what the frame shows that is neither CAD nor robot."""
    cell = Cell.load(CELL)
    world = World.demo(people=1, cell=cell)
    intrinsics = d435i_intrinsics(424, 240)
    T_world_camera = look_at(eye_m=(1.4, 0.0, 1.2), target_m=(0.0, 0.0, 0.2))
    depth = SimulatedCamera(world, T_world_camera, intrinsics).capture(1.0).depth  # (240, 424) uint16, mm
    joints = world.joints_at(1.0)  # (6,) rad, at the time of the frame

    pipeline = DepthPipeline(intrinsics, T_world_camera, cell)
    pipeline.process(depth, joints)  # at the first start kernels are compiled, which takes a while
    result = pipeline.process(depth, joints)
    centres_m = result.voxels.lattice.centres(result.voxels.indices)  # (N, 3) m, world frame

    print(f"pixels that remain: {int(pipeline.foreground(depth, joints).sum())} of {depth.size}")
    print(f"obstacle voxels: {len(centres_m)}")
    if len(centres_m):
        low, high = centres_m.min(axis=0).round(2), centres_m.max(axis=0).round(2)
        print(f"between {low.tolist()} and {high.tolist()} m")
    print(f"time: {result.times.total_ns / 1e6:.1f} ms")


if __name__ == "__main__":
    main()
