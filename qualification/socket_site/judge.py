# SPDX-License-Identifier: Apache-2.0
"""Comparison of units' reports with the simulation's truth: poses of cameras, and voxels of the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_unit.monitoring import TraceRecord, read_trace
from edge_unit.sources.simulated import SimulatedSourceConfig
from shared.cell import Cell
from shared.clock import NS_PER_S
from shared.lattice import Lattice
from shared.settings import Settings
from shared.transforms import Transform, angle_rad, from_xyz_rpy, inverse
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.cameras.truth import TruthFinder, false_voxels, has_near
from simulation.world.handling import LEFT_ALONE, Handling
from simulation.world.scene import Owner, View
from simulation.world.world import World

KEYS = np.dtype("<u4")

ROBOT_REACH = 1
"""Distance in voxels from the robot's surface within which a false voxel counts as the robot's.

The camera measures the edges of a thing beside it.
"""


def true_pose(cell: Cell, source: SimulatedSourceConfig, handled: Handling = LEFT_ALONE) -> Transform:
    """Return `T_world_camera` of a simulated camera that was handled."""
    return rig(cell, source.cameras)[source.camera] @ from_xyz_rpy(handled.xyz, np.radians(handled.rpy_deg))


def pose_errors(found: Transform, true: Transform) -> tuple[float, float]:
    """Return the error of a found pose: translation in mm, rotation in degrees."""
    turned = angle_rad(inverse(true) @ found)
    return 1e3 * float(np.linalg.norm(found[:3, 3] - true[:3, 3])), float(np.degrees(turned))


def first_voxel_s(trace_path: Path, started_ns: int) -> float:
    """Return the seconds from the start of a unit's process to the merge of its first voxel; NaN if there is none."""
    merged_ns = (record.merged_at_ns for record in read_trace(trace_path) if record.keys)
    return min(((at_ns - started_ns) / NS_PER_S for at_ns in merged_ns if at_ns is not None), default=float("nan"))


@dataclass
class Frames:
    """Number of judged frames, of frames with a false voxel, and of those with a voxel of the robot."""

    count: int = 0
    false: int = 0
    robot: int = 0

    def __add__(self, other: Frames) -> Frames:
        return Frames(self.count + other.count, self.false + other.false, self.robot + other.robot)

    @property
    def robot_percent(self) -> float:
        """Share of the frames with a voxel of the robot, in percent."""
        return 100.0 * self.robot / self.count if self.count else float("nan")

    @property
    def false_percent(self) -> float:
        """Share of the frames with any false voxel, in percent."""
        return 100.0 * self.false / self.count if self.count else float("nan")


class Judge:
    """Renders the frames of one simulated camera once more, and counts its false voxels."""

    def __init__(self, cell: Cell, source: SimulatedSourceConfig, settings: Settings) -> None:
        intrinsics = d435i_intrinsics(source.width, source.height)
        self._pose = true_pose(cell, source)
        self._camera = SimulatedCamera(World.demo(source.people, source.seed, cell), self._pose, intrinsics)
        self._lattice = cell.lattice(settings.voxel_size_m)
        self._finder = TruthFinder(intrinsics, self._pose, self._lattice, self._camera.noise)
        self._epoch_ns = source.epoch_ns

    def judge(self, trace: Sequence[TraceRecord], begin_ns: int, end_ns: int) -> Frames:
        """Judge the merged frames captured in [`begin_ns`, `end_ns`). The camera must be in its place meanwhile."""
        frames = Frames()
        for record in trace:
            if record.merged_at_ns is None or not begin_ns <= record.captured_at_ns < end_ns:
                continue
            frames.count += 1
            reported = np.frombuffer(record.keys, KEYS)
            if not len(reported):
                continue
            view = self._camera.look((record.captured_at_ns - self._epoch_ns) / NS_PER_S)
            false = false_voxels(reported, self._finder.find(view).surface_keys, self._lattice)
            if len(false):
                frames.false += 1
                robot = robot_keys(view, self._camera, self._lattice)
                frames.robot += bool(has_near(false, robot, self._lattice, ROBOT_REACH).any())
        return frames


def robot_keys(view: View, camera: SimulatedCamera, lattice: Lattice) -> NDArray[np.uint32]:
    """Return the keys (N,) of the voxels that hold the robot's visible surface."""
    rows, columns = np.nonzero(view.owner == int(Owner.ROBOT))
    z_m = view.z_m[rows, columns].astype(np.float64)
    k = camera.intrinsics
    in_camera_m = np.stack(((columns - k.cx) / k.fx * z_m, (rows - k.cy) / k.fy * z_m, z_m), axis=-1)
    pose = camera.T_world_camera
    indices = lattice.index(in_camera_m @ pose[:3, :3].T + pose[:3, 3])
    return np.unique(lattice.keys(indices[lattice.contains(indices)]))
