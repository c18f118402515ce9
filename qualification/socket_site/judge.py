# SPDX-License-Identifier: Apache-2.0
"""What plugged-in units told, held against the simulation's truth: where cameras hang, and what is robot."""

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
"""A false voxel within so many of the robot's own surface is the robot's: its edges are measured beside it."""


def true_pose(cell: Cell, source: SimulatedSourceConfig, handled: Handling = LEFT_ALONE) -> Transform:
    """`T_world_camera` of a simulated camera after what was done to it."""
    return rig(cell, source.cameras)[source.camera] @ from_xyz_rpy(handled.xyz, np.radians(handled.rpy_deg))


def pose_errors(found: Transform, true: Transform) -> tuple[float, float]:
    """How far the camera is from where it was found, mm, and turned, degrees."""
    turned = angle_rad(inverse(true) @ found)
    return 1e3 * float(np.linalg.norm(found[:3, 3] - true[:3, 3])), float(np.degrees(turned))


def first_voxel_s(trace_path: Path, started_ns: int) -> float:
    """From the start of a unit's process until the master had merged its first voxel; NaN when it never did."""
    merged_ns = (record.merged_at_ns for record in read_trace(trace_path) if record.keys)
    return min(((at_ns - started_ns) / NS_PER_S for at_ns in merged_ns if at_ns is not None), default=float("nan"))


@dataclass
class Frames:
    """Frames that were judged, and in how many of them a voxel was false, of these the robot's."""

    count: int = 0
    false: int = 0
    robot: int = 0

    def __add__(self, other: Frames) -> Frames:
        return Frames(self.count + other.count, self.false + other.false, self.robot + other.robot)

    @property
    def robot_percent(self) -> float:
        """Share of the frames with a voxel of the robot."""
        return 100.0 * self.robot / self.count if self.count else float("nan")

    @property
    def false_percent(self) -> float:
        """Share of the frames with any false voxel."""
        return 100.0 * self.false / self.count if self.count else float("nan")


class Judge:
    """One simulated camera's frames, drawn once more."""

    def __init__(self, cell: Cell, source: SimulatedSourceConfig, settings: Settings) -> None:
        intrinsics = d435i_intrinsics(source.width, source.height)
        self._pose = true_pose(cell, source)
        self._camera = SimulatedCamera(World.demo(source.people, source.seed, cell), self._pose, intrinsics)
        self._lattice = cell.lattice(settings.voxel_size_m)
        self._finder = TruthFinder(intrinsics, self._pose, self._lattice, self._camera.noise)
        self._epoch_ns = source.epoch_ns

    def judge(self, trace: Sequence[TraceRecord], begin_ns: int, end_ns: int) -> Frames:
        """The frames that were captured then and merged; nobody touched the camera meanwhile."""
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
    """Keys of the voxels in which the robot's visible surface lies."""
    rows, columns = np.nonzero(view.owner == int(Owner.ROBOT))
    z_m = view.z_m[rows, columns].astype(np.float64)
    k = camera.intrinsics
    in_camera_m = np.stack(((columns - k.cx) / k.fx * z_m, (rows - k.cy) / k.fy * z_m, z_m), axis=-1)
    pose = camera.T_world_camera
    indices = lattice.index(in_camera_m @ pose[:3, :3].T + pose[:3, 3])
    return np.unique(lattice.keys(indices[lattice.contains(indices)]))
