# SPDX-License-Identifier: Apache-2.0
"""The contenders: one unit at its frame, all cameras in one process, and all cameras into one octree.

All of them use one thread and the same frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper_experiment.scene import CAMERAS, Views
from edge_unit.pipeline import DepthPipeline
from edge_unit.uplink.assignment import seen_report
from master_server.core import MergedMap
from shared.clock import NS_PER_MS, stage_ns
from shared.messages import Health, SeenReport
from shared.settings import FilterSettings
from shared.wire import keys_to_bytes


@dataclass(frozen=True, eq=False)
class Sight:
    """A unit's report of a frame: the keys (N,) uint32 of its voxels, and the parts of its update."""

    voxels: NDArray[np.uint32]
    keys: bytes
    seen: SeenReport
    health: Health


class UnitWork:
    """All work of a unit between a frame and its update."""

    def __init__(self, pipeline: DepthPipeline) -> None:
        self.pipeline = pipeline

    def resize(self, voxel_size_m: float) -> None:
        """Change the voxel size."""
        self.pipeline.apply(FilterSettings(voxel_size_m=voxel_size_m))

    def filter_frame(self, depth: NDArray[np.uint16], joints: NDArray[np.float64]) -> Sight:
        """Filter a frame and report seen and health. The seen report is made anew each time."""
        result = self.pipeline.process(depth, joints)
        voxels, health = result.voxels, result.health
        told = Health(
            valid_share=health.valid_share,
            agreeing_share=health.agreeing_share,
            residual_share=health.residual_share,
            static_share=health.static_share,
            process_ms=round(result.times.total_ns / NS_PER_MS, 3),
        )
        return Sight(voxels.keys, keys_to_bytes(voxels.keys), seen_report(result.seen), told)


class Centralised:
    """The same pipelines in one process, all cameras in turn, merged by the master's own class."""

    def __init__(self, work: Sequence[UnitWork]) -> None:
        self._work = work
        self._map = MergedMap(work[0].pipeline.lattice)
        self.merged: NDArray[np.uint32] = np.empty(0, np.uint32)
        """Keys that the last refresh found."""

    def refresh(self, views: Views, n: int) -> list[float]:
        """Return the milliseconds until the map holds the first camera, the first two, and so on, at moment `n`."""
        lattice = self._work[0].pipeline.lattice
        if self._map.lattice != lattice:
            self._map = MergedMap(lattice)
        for camera in range(len(self._work)):
            self._map.withdraw(camera)
        spent_ms, until_ms = 0.0, []
        for camera, work in enumerate(self._work):
            began_ns = stage_ns()
            pipeline = work.pipeline
            # A central computer must compute seen and health, too.
            voxels = pipeline.process(views.depth[camera, n], views.joints[n]).voxels
            self._map.replace(camera, voxels.keys)
            filtered_ns = stage_ns()
            self.merged, _ = self._map.voxels()
            merged_ns = stage_ns()
            spent_ms += (filtered_ns - began_ns) / NS_PER_MS
            until_ms.append(spent_ms + (merged_ns - filtered_ns) / NS_PER_MS)
        return until_ms


class IntoOctree:
    """The way of MoveIt's updaters: robot and CAD are removed from the cloud, and the rest goes into one OctoMap.

    In its favour: the CAD's expected depth is known beforehand, and Embree draws each link within its own rectangle.
    Rays that clear the free space go only to the remaining points, not to the robot and the CAD (MoveIt casts these,
    too), and once per hit voxel, not once per pixel. No lock is shared with a planner.
    """

    def __init__(self, views: Views, work: Sequence[UnitWork]) -> None:
        """Make the octree. It needs the peers of `make bench-paper`."""
        import octomap

        from benchmarks.peers import contenders

        self._views = views
        self._cameras = [contenders.Camera(views.intrinsics, pose, views.cell) for pose in views.poses]
        self._robots = [contenders.Embree(camera) for camera in self._cameras]
        self._static_m = [each.pipeline.expected_depth(None) for each in work]
        settings, intrinsics = work[0].pipeline.settings, views.intrinsics
        self._margin_m = np.float32(settings.margin_base_m)
        self._padding_m = np.float32(settings.robot_padding_m)
        noise_per_m = settings.margin_noise_gain * intrinsics.disparity_noise_m(settings.stereo_subpixel_px)
        self._noise_per_m = np.float32(noise_per_m)
        self._new_tree: Callable[[float], octomap.OcTree] = octomap.OcTree
        self.resize(settings.voxel_size_m)

    def resize(self, voxel_size_m: float) -> None:
        """Start a new octree with voxels of this size."""
        self._tree = self._new_tree(voxel_size_m)

    def refresh(self, n: int) -> list[float]:
        """Return the milliseconds until the octree holds the first camera, the first two, and so on, at moment `n`."""
        began_ns, until_ms = stage_ns(), []
        for camera in range(CAMERAS):
            self.insert(camera, n)
            until_ms.append((stage_ns() - began_ns) / NS_PER_MS)
        return until_ms

    def insert(self, camera: int, n: int) -> None:
        """Insert one frame: self filter, points, occupied voxels and free rays."""
        eye, depth = self._cameras[camera], self._views.depth[camera, n]
        points_m = eye.points_m(depth, self.foreground(camera, n))
        origin_m = np.ascontiguousarray(eye.T_world_camera[:3, 3])
        self._tree.insertPointCloud(points_m, origin_m, discretize=True)

    def foreground(self, camera: int, n: int) -> NDArray[np.bool_]:
        """Return the pixels (H, W) that are neither CAD nor robot: before the CAD's margin, off the padded robot."""
        z_m = self._views.depth[camera, n] * np.float32(self._views.intrinsics.depth_scale_m)
        robot_m = self._robots[camera].robot_depth_link_by_link(self._views.joints[n]) - self._padding_m
        expected_m = np.minimum(self._static_m[camera], robot_m)
        limit_m = np.float32(1.0) / (np.float32(1.0) / expected_m + self._noise_per_m) - self._margin_m
        return np.asarray((z_m > 0.0) & (z_m < limit_m))


def prepared(views: Views, voxel_size_m: float) -> list[UnitWork]:
    """Return the work of each camera's unit."""
    return [UnitWork(views.pipeline(camera, voxel_size_m)) for camera in range(CAMERAS)]
