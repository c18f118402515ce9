# SPDX-License-Identifier: Apache-2.0
"""Ground truth of a frame: voxels that should be reported, and voxels that must not.

A voxel is *visible* if it shows at least `VISIBLE_SHARE` of the points of a square of its size that faces the camera
(`fx * fy * (size / z)²`, with z the depth of its centre). It is *outside* the margin if as many of these points are
nearer than the limit of the known surfaces.

*Surface* is every voxel in which a true point of an unknown object may be measured: the point moved along its ray by up
to `NOISE_SIGMAS` standard deviations of depth. A reported voxel is false if neither it nor one of its neighbours (26,
or all within `reach` voxels) is surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.bundles import plain
from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import Camera
from geometry.rendering.kernel_camera import camera_of
from shared.camera import Intrinsics
from shared.lattice import Lattice
from shared.transforms import Transform, inverse
from simulation.cameras.depth_noise import DepthNoise
from simulation.world.scene import FIRST_UNKNOWN, View

VISIBLE_SHARE = 0.1
"""Least share of the pinhole count: fewer points are a sliver at the rim of an object, or a grazing angle."""

NOISE_SIGMAS = 3.0
"""Limit of noise in standard deviations: one point in 370 is measured farther off."""

SIGMA_STEP_M = 0.05
"""Step in depth of the table of tolerances; within one step, noise grows by a few per cent."""

MAX_DEPTH_M = 20.0
"""End of the table; no cell is that deep."""


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """Voxels that one camera could have reported at one moment.

    Attributes:
        visible_keys: (N,) uint32 ascending, voxels with enough true points of unknown objects.
        visible_counts: (N,) uint32, their numbers of points.
        outside: (N,) bool, True for those with enough points outside the margin of known surfaces.
        surface_keys: (M,) uint32 ascending, voxels in which such a point may be measured.
    """

    visible_keys: NDArray[np.uint32]
    visible_counts: NDArray[np.uint32]
    outside: NDArray[np.bool_]
    surface_keys: NDArray[np.uint32]

    @property
    def outside_keys(self) -> NDArray[np.uint32]:
        """Visible voxels that must be reported."""
        return self.visible_keys[self.outside]

    @property
    def margin_keys(self) -> NDArray[np.uint32]:
        """Visible voxels so close before a known surface that they need not be reported."""
        return self.visible_keys[~self.outside]


class Grid(NamedTuple):
    """The lattice: its origin (3,), voxel size and shape (3,)."""

    origin_m: NDArray[np.float64]
    voxel_size_m: float
    shape: NDArray[np.int64]


class Found(NamedTuple):
    """Keys of the voxels of all unknown pixels, of those outside the margin, and of those in which such points may be
    measured, each once. `marked` (cells,) is scratch, all False before and after.
    """

    inside: NDArray[np.uint32]
    beyond_margin: NDArray[np.uint32]
    surface: NDArray[np.uint32]
    marked: NDArray[np.bool_]


class TruthFinder:
    """Compute the ground truth of one camera's frames on one lattice."""

    def __init__(self, intrinsics: Intrinsics, T_world_camera: Transform, lattice: Lattice, noise: DepthNoise) -> None:
        self._intrinsics = intrinsics
        self._T_world_camera = T_world_camera
        self._view_axis = inverse(T_world_camera)[2]
        self._lattice = lattice
        depths_m = np.arange(SIGMA_STEP_M, MAX_DEPTH_M, SIGMA_STEP_M)
        sigma_m = noise.sigma_of(depths_m, intrinsics)
        self._tolerance_m = np.concatenate((sigma_m[:1], sigma_m)) * NOISE_SIGMAS
        self._inside = np.empty(intrinsics.width * intrinsics.height, dtype=np.uint32)
        self._beyond_margin = np.empty_like(self._inside)
        self._marked = np.zeros(lattice.cell_count, dtype=np.bool_)
        self._surface = np.empty(lattice.cell_count, dtype=np.uint32)

    def find(self, view: View, limit_m: NDArray[np.float32] | None = None) -> FrameTruth:
        """Return the ground truth for the view of a perfect camera.

        `limit_m` (H, W) float32: a pixel is outside the margin if its true depth is below it (inf: no known surface).
        None: all pixels are outside.
        """
        lattice = self._lattice
        limits = np.full((1, 1), np.inf, dtype=np.float32) if limit_m is None else limit_m
        inside, beyond, surface = find_keys(
            view.z_m,
            view.owner,
            int(FIRST_UNKNOWN),
            limits,
            self._tolerance_m,
            camera_of(self._intrinsics),
            self._T_world_camera,
            plain(Grid(np.array(lattice.origin_m), lattice.voxel_size_m, np.array(lattice.shape))),
            plain(Found(self._inside, self._beyond_margin, self._surface, self._marked)),
        )
        keys, counts = np.unique(self._inside[:inside], return_counts=True)
        outside_keys, outside_counts = np.unique(self._beyond_margin[:beyond], return_counts=True)
        enough = counts >= self._enough(keys)
        outside_keys = outside_keys[outside_counts >= self._enough(outside_keys)]
        keys = keys[enough]
        return FrameTruth(
            keys,
            counts[enough].astype(np.uint32),
            np.isin(keys, outside_keys, assume_unique=True),
            np.sort(self._surface[:surface]),
        )

    def _enough(self, keys: NDArray[np.uint32]) -> NDArray[np.float64]:
        """Return the number of points that makes each voxel visible."""
        centres_m = self._lattice.centres(self._lattice.indices(keys))
        z_m = np.maximum(centres_m @ self._view_axis[:3] + self._view_axis[3], 1e-3)
        full = self._intrinsics.fx * self._intrinsics.fy * (self._lattice.voxel_size_m / z_m) ** 2
        return np.asarray(VISIBLE_SHARE * full)


def false_voxels(
    reported: NDArray[np.uint32], surface: NDArray[np.uint32], lattice: Lattice, reach: int = 1
) -> NDArray[np.uint32]:
    """Return the `reported` keys (N,) without a `surface` key (M,) within `reach` voxels along each axis.

    For several cameras, `surface` contains the keys of all of them, in any order.
    """
    return reported[~has_near(reported, surface, lattice, reach)]


def missed_voxels(
    visible: NDArray[np.uint32], reported: NDArray[np.uint32], lattice: Lattice, reach: int = 1
) -> NDArray[np.uint32]:
    """Return the `visible` keys (N,) without a `reported` key (M,) within `reach` voxels along each axis.

    With `reach` 0, a point that noise moved over a voxel's border counts as missed.
    """
    return visible[~has_near(visible, reported, lattice, reach)]


def has_near(keys: NDArray[np.uint32], others: NDArray[np.uint32], lattice: Lattice, reach: int) -> NDArray[np.bool_]:
    """Return (N,) bool: True for `keys` (N,) with one of `others` (M,) within `reach` voxels along each axis."""
    found = np.empty(len(keys), dtype=np.bool_)
    near_keys(keys, others, np.array(lattice.shape), reach, np.zeros(lattice.cell_count, dtype=np.bool_), found)
    return found


@kernel
def find_keys(
    z_m: NDArray[np.float32],
    owner: NDArray[np.uint8],
    first_unknown: int,
    limit_m: NDArray[np.float32],
    tolerance_m: NDArray[np.float64],
    camera: Camera,
    T_world_camera: NDArray[np.float64],
    grid: Grid,
    found: Found,
) -> tuple[int, int, int]:
    """Find the voxels in which the unknown pixels of a view may be reported; return the numbers of keys `found`.

    Points nearer than `limit_m` ((H, W), or (1, 1) for all) are outside the margin. `tolerance_m` is over depth in
    steps of `SIGMA_STEP_M`.
    """
    fx, fy, cx, cy, width, height = Camera(*camera)
    origin_m, voxel_size_m, shape = Grid(*grid)
    inside, beyond_margin, surface, marked = Found(*found)
    t = T_world_camera
    scale = 1.0 / voxel_size_m
    last = len(tolerance_m) - 1
    count, outside, touched = 0, 0, 0
    # In voxels: the origin of all rays, and below it the step of each for a metre of depth.
    ax = (t[0, 3] - origin_m[0]) * scale
    ay = (t[1, 3] - origin_m[1]) * scale
    az = (t[2, 3] - origin_m[2]) * scale
    for y in range(height):
        for x in range(width):
            if owner[y, x] < first_unknown:
                continue
            z = z_m[y, x]
            rx, ry = (x - cx) / fx, (y - cy) / fy
            dx = (t[0, 0] * rx + t[0, 1] * ry + t[0, 2]) * scale
            dy = (t[1, 0] * rx + t[1, 1] * ry + t[1, 2]) * scale
            dz = (t[2, 0] * rx + t[2, 1] * ry + t[2, 2]) * scale
            key = voxel_key(ax + z * dx, ay + z * dy, az + z * dz, shape)
            if key >= 0:
                inside[count] = key
                count += 1
                if z < limit_m[min(y, limit_m.shape[0] - 1), min(x, limit_m.shape[1] - 1)]:
                    beyond_margin[outside] = key
                    outside += 1
            tolerance = tolerance_m[min(int(z / SIGMA_STEP_M) + 1, last)]
            # Half a voxel a step: a skipped voxel is a neighbour of a found one.
            steps = int(np.ceil(tolerance * 2.0 * scale))
            for k in range(-steps, steps + 1):
                here = z + tolerance * k / max(steps, 1)
                key = voxel_key(ax + here * dx, ay + here * dy, az + here * dz, shape)
                if key >= 0 and not marked[key]:
                    marked[key] = True
                    surface[touched] = key
                    touched += 1
    for i in range(touched):
        marked[surface[i]] = False
    return count, outside, touched


@kernel
def voxel_key(ix: float, iy: float, iz: float, shape: NDArray[np.int64]) -> int:
    """Return the key of a position in voxels; -1 outside the lattice."""
    jx, jy, jz = int(np.floor(ix)), int(np.floor(iy)), int(np.floor(iz))
    if jx < 0 or jy < 0 or jz < 0 or jx >= shape[0] or jy >= shape[1] or jz >= shape[2]:
        return -1
    return int((jx * shape[1] + jy) * shape[2] + jz)


@kernel
def near_keys(
    keys: NDArray[np.uint32],
    others: NDArray[np.uint32],
    shape: NDArray[np.int64],
    reach: int,
    marked: NDArray[np.bool_],
    found: NDArray[np.bool_],
) -> None:
    """Set `found` (N,) for `keys` (N,) with one of `others` (M,) within `reach` voxels.

    `marked` (cells,) is scratch, all False before.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    for i in range(len(others)):
        marked[others[i]] = True
    for i in range(len(keys)):
        key = np.int64(keys[i])
        iz, iy, ix = key % nz, key // nz % ny, key // (nz * ny)
        found[i] = False
        for jx in range(max(ix - reach, 0), min(ix + reach, nx - 1) + 1):
            for jy in range(max(iy - reach, 0), min(iy + reach, ny - 1) + 1):
                for jz in range(max(iz - reach, 0), min(iz + reach, nz - 1) + 1):
                    if marked[(jx * ny + jy) * nz + jz]:
                        found[i] = True
