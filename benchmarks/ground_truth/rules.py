# SPDX-License-Identifier: Apache-2.0
"""The rules that are compared, each on the same frames, the same picture of what is known, and the same robot mask.

Ours is the whole pipeline. The others are written here, in numpy, after what they are named for, and share no code with
it but the picture of what is known, which is handed to them: rules are compared, not renderers.
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
"""The offset before what is known, of the rules that have a fixed one: the paper gives no figure. Three standard
deviations of a D435i at 2 m are 75 mm."""

PAPER_THRESHOLD = 0.55
"""The paper: "around 50-60 % of the maximum value"."""

POINTS_MIN = 5
"""STVL's own default asks for one point a voxel; those who set it ask for a few."""


@dataclass(frozen=True, eq=False)
class Place:
    """One camera in one cell."""

    intrinsics: Intrinsics
    T_world_camera: Transform
    cell: Cell


@dataclass(frozen=True, eq=False)
class Measured:
    """One frame: depth (H, W) uint16, joints (n,) rad or none, what is known, and which pixels are robot.

    `known_m` (H, W) float32 is the depth of what stands still, inf where nothing is known; `robot` (H, W) bool.
    """

    depth: NDArray[np.uint16]
    joints: NDArray[np.float64] | None
    known_m: NDArray[np.float32]
    robot: NDArray[np.bool_]
    _points_m: dict[float, NDArray[np.float64]] = field(default_factory=dict)

    def points_m(self, place: Place, limit_m: float) -> NDArray[np.float64]:
        """World positions (N, 3) of the pixels `before` a fixed limit; reckoned once for all rules that share it."""
        if limit_m not in self._points_m:
            self._points_m[limit_m] = points(place, self, before(place, self, limit_m))
        return self._points_m[limit_m]


Filter = Callable[[Measured], NDArray[np.uint32]]
"""From a frame to the keys (N,) of the voxels that are reported, ascending."""


class Rule(Protocol):
    """How one contender decides; `at` prepares it for one place and one size of voxels."""

    def at(self, place: Place, voxel_size_m: float) -> Filter:
        """Its filter there."""
        ...


@dataclass(frozen=True)
class Ours:
    """The pipeline, with all it knows."""

    settings: FilterSettings

    def at(self, place: Place, voxel_size_m: float) -> Filter:
        """See `Rule`."""
        settings = self.settings.model_copy(update={"voxel_size_m": voxel_size_m})
        pipeline = DepthPipeline(place.intrinsics, place.T_world_camera, place.cell, settings)
        return lambda frame: pipeline.process(frame.depth, frame.joints).voxels.keys


@dataclass(frozen=True)
class Paper:
    """The paper's filter as it is written: one offset for all depths, and each voxel judged by itself."""

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
    """As STVL and its like do: a plain subtraction of the background, then a least number of points a voxel."""

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
"""A ceiling: every voxel into which one pixel of a thing was measured that stands a metre before what is known."""


def before(place: Place, frame: Measured, limit_m: float) -> NDArray[np.bool_]:
    """Pixels (H, W) measured nearer than what is known less a fixed offset (the paper's Figure 8), and not robot."""
    depth_m = frame.depth * place.intrinsics.depth_scale_m
    return np.asarray((frame.depth > 0) & (depth_m < frame.known_m - limit_m) & ~frame.robot)


def points(place: Place, frame: Measured, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """World positions (N, 3) in metres of the `chosen` pixels (H, W)."""
    camera = place.intrinsics
    rows, columns = np.nonzero(chosen)
    z_m = frame.depth[rows, columns] * camera.depth_scale_m
    x_m, y_m = (columns - camera.cx) / camera.fx * z_m, (rows - camera.cy) / camera.fy * z_m
    t = place.T_world_camera
    # Without a product of matrices: its threads cost more than they save.
    return np.stack([t[k, 0] * x_m + t[k, 1] * y_m + t[k, 2] * z_m + t[k, 3] for k in range(3)], axis=-1)


def algorithm_1(points_m: NDArray[np.float64], voxel_size_m: float) -> NDArray[np.float64]:
    """The paper's voxels (N, 3) of points from the lattice's corner: with half a length added to a number."""
    return np.floor(points_m / voxel_size_m + 0.5 * voxel_size_m)


def algorithm_6(voxel_size_m: float, distance_m: NDArray[np.float64], camera: Intrinsics) -> NDArray[np.float64]:
    """The paper's largest possible number of points in voxels at distances (N,), by angles averaged over the view."""
    alfa = np.arctan(voxel_size_m / distance_m)
    per_column = 2.0 * math.atan(0.5 * camera.width / camera.fx) / camera.width
    per_row = 2.0 * math.atan(0.5 * camera.height / camera.fy) / camera.height
    return np.asarray((alfa / per_row) * (alfa / per_column))


def counted(lattice: Lattice, indices: NDArray[np.float64]) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Keys (M,), ascending, of the voxels on the lattice that are among `indices` (N, 3), and how often each is."""
    inside = indices[lattice.contains(indices)].astype(np.int64)
    keys, counts = np.unique(lattice.keys(inside), return_counts=True)
    return keys, counts
