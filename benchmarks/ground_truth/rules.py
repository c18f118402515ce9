# SPDX-License-Identifier: Apache-2.0
"""The compared rules. Each gets the same frames, the same expected depth and the same robot mask.

Ours is the whole pipeline. The others are written here in numpy, after the methods that they are named for. They share
no code with the pipeline except the expected depth, which is handed to them: the benchmark compares rules, not
renderers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.lattice import Lattice
from shared.settings import FilterSettings
from shared.transforms import Transform

LIMIT_M = 0.10
"""Offset before the expected depth, for the rules that have a fixed one. The paper gives no figure. Three standard
deviations of a D435i at 2 m are 75 mm.
"""

PAPER_THRESHOLD = 0.55
"""Threshold of the paper: "around 50-60 % of the maximum value"."""

POINTS_MIN = 5
"""STVL's default is one point per voxel; users who change it set a few."""


@dataclass(frozen=True, eq=False)
class Place:
    """One camera in one cell."""

    intrinsics: Intrinsics
    T_world_camera: Transform
    cell: Cell


@dataclass(frozen=True, eq=False)
class Measured:
    """One frame: depth (H, W) uint16, joints (n,) rad or None, the static expected depth, and the robot mask.

    `known_m` (H, W) float32 is the depth of the static surfaces, inf if nothing is known; `robot` (H, W) bool.
    """

    depth: NDArray[np.uint16]
    joints: NDArray[np.float64] | None
    known_m: NDArray[np.float32]
    robot: NDArray[np.bool_]
    _points_m: dict[float, NDArray[np.float64]] = field(default_factory=dict)

    def points_m(self, place: Place, limit_m: float) -> NDArray[np.float64]:
        """Return the world positions (N, 3) of the pixels `before` a fixed limit. All rules that share the limit share
        the result.
        """
        if limit_m not in self._points_m:
            self._points_m[limit_m] = points(place, self, before(place, self, limit_m))
        return self._points_m[limit_m]


Filter = Callable[[Measured], NDArray[np.uint32]]
"""Maps a frame to the keys (N,) of the reported voxels, ascending."""


class Rule(Protocol):
    """Filter of one contender. `at` prepares it for one place and one voxel size."""

    def at(self, place: Place, voxel_size_m: float) -> Filter:
        """Return the filter for this place and voxel size."""
        ...


@dataclass(frozen=True)
class Ours:
    """The whole pipeline, with everything that it knows."""

    settings: FilterSettings

    def at(self, place: Place, voxel_size_m: float) -> Filter:
        """See `Rule`."""
        settings = self.settings.model_copy(update={"voxel_size_m": voxel_size_m})
        pipeline = DepthPipeline(place.intrinsics, place.T_world_camera, place.cell, settings)
        return lambda frame: pipeline.process(frame.depth, frame.joints).voxels.keys


@dataclass(frozen=True)
class Paper:
    """The paper's filter as written: one offset for all depths, and each voxel judged by itself."""

    limit_m: float = LIMIT_M
    threshold: float = PAPER_THRESHOLD

    def at(self, place: Place, voxel_size_m: float) -> Filter:
        """See `Rule`."""
        lattice = place.cell.lattice(voxel_size_m)
        camera_m = place.T_world_camera[:3, 3]

        def found(frame: Measured) -> NDArray[np.uint32]:
            points_m = frame.points_m(place, self.limit_m)
            keys, counts = counted(lattice, algorithm_1(points_m - np.array(lattice.origin_m), voxel_size_m))
            distance_m = np.linalg.norm(lattice.centres(lattice.indices(keys)) - camera_m, axis=1)
            # Algorithm 7: "if(voxel.count < maxCount * threshold) voxels.Delete(voxel)".
            return keys[counts >= algorithm_6(voxel_size_m, distance_m, place.intrinsics) * self.threshold]

        return found


@dataclass(frozen=True)
class MinimumPoints:
    """The rule of STVL and similar layers: subtract the background, then require a minimum of points per voxel."""

    limit_m: float = LIMIT_M
    points: int = POINTS_MIN

    def at(self, place: Place, voxel_size_m: float) -> Filter:
        """See `Rule`."""
        lattice = place.cell.lattice(voxel_size_m)

        def found(frame: Measured) -> NDArray[np.uint32]:
            points_m = frame.points_m(place, self.limit_m)
            keys, counts = counted(lattice, np.floor((points_m - np.array(lattice.origin_m)) / voxel_size_m))
            return keys[counts >= self.points]

        return found


ANY_PIXEL = MinimumPoints(0.5, 1)
"""Upper bound: every voxel with one measured pixel that lies a metre before the known surface."""


def before(place: Place, frame: Measured, limit_m: float) -> NDArray[np.bool_]:
    """Return the pixels (H, W) that are nearer than the known surface less a fixed offset (the paper's Figure 8), and
    not robot.
    """
    depth_m = frame.depth * place.intrinsics.depth_scale_m
    return np.asarray((frame.depth > 0) & (depth_m < frame.known_m - limit_m) & ~frame.robot)


def points(place: Place, frame: Measured, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the world positions (N, 3) in metres of the `chosen` pixels (H, W)."""
    camera = place.intrinsics
    rows, columns = np.nonzero(chosen)
    z_m = frame.depth[rows, columns] * camera.depth_scale_m
    x_m, y_m = (columns - camera.cx) / camera.fx * z_m, (rows - camera.cy) / camera.fy * z_m
    t = place.T_world_camera
    # No matrix product: its threads cost more than they save.
    return np.stack([t[k, 0] * x_m + t[k, 1] * y_m + t[k, 2] * z_m + t[k, 3] for k in range(3)], axis=-1)


def algorithm_1(points_m: NDArray[np.float64], voxel_size_m: float) -> NDArray[np.float64]:
    """Return the paper's voxels (N, 3) of points relative to the lattice's corner. Half a length is added to a number,
    as in the paper.
    """
    return np.floor(points_m / voxel_size_m + 0.5 * voxel_size_m)


def algorithm_6(voxel_size_m: float, distance_m: NDArray[np.float64], camera: Intrinsics) -> NDArray[np.float64]:
    """Return the paper's maximum number of points in voxels at distances (N,), from angles averaged over the view."""
    alfa = np.arctan(voxel_size_m / distance_m)
    per_column = 2.0 * math.atan(0.5 * camera.width / camera.fx) / camera.width
    per_row = 2.0 * math.atan(0.5 * camera.height / camera.fy) / camera.height
    return np.asarray((alfa / per_row) * (alfa / per_column))


def counted(lattice: Lattice, indices: NDArray[np.float64]) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Return the keys (M,), ascending, of those `indices` (N, 3) that lie on the lattice, and the count of each."""
    inside = indices[lattice.contains(indices)].astype(np.int64)
    keys, counts = np.unique(lattice.keys(inside), return_counts=True)
    return keys, counts
