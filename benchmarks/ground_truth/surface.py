# SPDX-License-Identifier: Apache-2.0
"""Compares the reported voxels of one frame with the surface that a perfect camera would have seen.

A voxel is *visible* if the true surface of the unknown thing covers at least `simulation.cameras.truth.VISIBLE_SHARE`
of the pixels of a full voxel, `fx * fy * (size / z)²`, in it. A visible voxel is found *strictly* if it is reported
itself, and *within a voxel* if it or one of its 26 neighbours is reported. Holes and shadows, which the camera does not
measure, count as missed.

A reported voxel is *false* if its centre is farther from all of that surface than a voxel's diagonal and three standard
deviations of depth there.

The *error of distance* is the distance of the nearest reported voxel, as a cube, less the distance of the nearest point
of the true visible surface. Below 0 the map shows the thing too near, above 0 too far. The distance is taken from the
camera, and from a possible place of a tool, `TOOL_M` beside the thing. The error is infinite if nothing is reported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.ground_truth.rules import Place
from shared.lattice import Lattice
from shared.transforms import apply
from simulation.cameras.depth_noise import DepthNoise
from simulation.cameras.truth import NOISE_SIGMAS, VISIBLE_SHARE, TruthFinder, has_near
from simulation.world.scene import FIRST_UNKNOWN, View

TOOL_M = 0.3
"""Distance of the tool from the thing, perpendicular to the line of sight."""

POINTS_MAX = 15_000
"""Maximum number of surface points that are kept for distances: a few millimetres apart on the largest thing."""


@dataclass
class Tally:
    """Counts over a number of frames; errors in metres, one per frame."""

    frames: int = 0
    visible: int = 0
    found: int = 0
    found_strictly: int = 0
    lost_frames: int = 0
    false: int = 0
    false_frames: int = 0
    tool_errors_m: list[float] = field(default_factory=list)
    camera_errors_m: list[float] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Add `other`'s frames to these."""
        self.frames += other.frames
        self.visible += other.visible
        self.found += other.found
        self.found_strictly += other.found_strictly
        self.lost_frames += other.lost_frames
        self.false += other.false
        self.false_frames += other.false_frames
        self.tool_errors_m += other.tool_errors_m
        self.camera_errors_m += other.camera_errors_m


@dataclass(frozen=True, eq=False)
class Surface:
    """The true visible surface of the unknown things of one frame; empty if nothing unknown is in sight.

    Attributes:
        view: image of a perfect camera.
        points_m: (N, 3) in the world.
        tolerance_m: (N,) three standard deviations of depth at each point.
        tree: search tree of the points.
        tool_m: (3,) position of the tool.
    """

    view: View
    points_m: NDArray[np.float64]
    tolerance_m: NDArray[np.float64]
    tree: cKDTree | None
    tool_m: NDArray[np.float64]

    @classmethod
    def of(cls, view: View, place: Place, noise: DepthNoise, rng: np.random.Generator) -> Surface:
        """Make the surface from the view of a perfect camera. `rng` chooses the side of the tool and the points that
        are kept.
        """
        rows, columns = np.nonzero((view.owner >= FIRST_UNKNOWN) & np.isfinite(view.z_m))
        if len(rows) > POINTS_MAX:
            kept = np.sort(rng.choice(len(rows), POINTS_MAX, replace=False))
            rows, columns = rows[kept], columns[kept]
        camera = place.intrinsics
        z_m = view.z_m[rows, columns].astype(np.float64)
        seen_m = np.stack(
            ((columns - camera.cx) / camera.fx * z_m, (rows - camera.cy) / camera.fy * z_m, z_m), axis=-1
        )  # fmt: skip
        angle = rng.uniform(0.0, 2.0 * math.pi)
        if not len(rows):
            return cls(view, seen_m, z_m, None, np.zeros(3))
        side = np.array((math.cos(angle), math.sin(angle), 0.0))
        middle_m = 0.5 * (seen_m.min(axis=0) + seen_m.max(axis=0))
        tool_m = middle_m + side * (((seen_m - middle_m) @ side).max() + TOOL_M)
        world_m = apply(place.T_world_camera, seen_m)
        tolerance_m = NOISE_SIGMAS * noise.sigma_of(z_m, camera)
        return cls(view, world_m, tolerance_m, cKDTree(world_m), apply(place.T_world_camera, tool_m))


class Judge:
    """Compares the voxels reported on one lattice with the truth."""

    def __init__(self, place: Place, lattice: Lattice, noise: DepthNoise) -> None:
        self._place = place
        self._lattice = lattice
        self._finder = TruthFinder(place.intrinsics, place.T_world_camera, lattice, noise)
        self._visible: tuple[Surface, NDArray[np.uint32]] | None = None

    def judge(self, surface: Surface, reported: NDArray[np.uint32]) -> Tally:
        """Judge one frame: `reported` are the keys (N,) of the reported voxels, `surface` is the true surface."""
        lattice = self._lattice
        visible = self._visible_keys(surface)
        near = has_near(visible, reported, lattice, 1)
        middles_m = lattice.centres(lattice.indices(reported))
        false = self._false(surface, middles_m)
        tally = Tally(
            frames=1,
            visible=len(visible),
            found=int(near.sum()),
            found_strictly=int(np.isin(visible, reported, assume_unique=True).sum()),
            lost_frames=int(len(visible) > 0 and not near.any()),
            false=false,
            false_frames=int(false > 0),
        )
        if len(visible):
            camera_m = self._place.T_world_camera[:3, 3]
            tally.tool_errors_m.append(self._error_m(surface, middles_m, surface.tool_m))
            tally.camera_errors_m.append(self._error_m(surface, middles_m, camera_m))
        return tally

    def _visible_keys(self, surface: Surface) -> NDArray[np.uint32]:
        """Return the keys of the visible voxels. They are cached for the other contenders on the same frame."""
        if self._visible is None or self._visible[0] is not surface:
            self._visible = surface, self._finder.find(surface.view).visible_keys
        return self._visible[1]

    def _false(self, surface: Surface, middles_m: NDArray[np.float64]) -> int:
        if surface.tree is None or not len(middles_m):
            return len(middles_m)
        distance_m, nearest = surface.tree.query(middles_m)
        diagonal_m = math.sqrt(3.0) * self._lattice.voxel_size_m
        return int((distance_m > diagonal_m + surface.tolerance_m[nearest]).sum())

    def _error_m(self, surface: Surface, middles_m: NDArray[np.float64], eye_m: NDArray[np.float64]) -> float:
        if not len(middles_m):
            return math.inf
        outside_m = np.maximum(np.abs(middles_m - eye_m) - 0.5 * self._lattice.voxel_size_m, 0.0)
        true_m = np.linalg.norm(surface.points_m - eye_m, axis=1).min()
        return float(np.linalg.norm(outside_m, axis=1).min() - true_m)


def visible_pixels_min(place: Place, voxel_size_m: float, distance_m: float) -> int:
    """Return the N of "at least N pixels" for a voxel at that distance from the camera."""
    full = place.intrinsics.fx * place.intrinsics.fy * (voxel_size_m / distance_m) ** 2
    return max(math.ceil(VISIBLE_SHARE * full), 1)
