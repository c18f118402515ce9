# SPDX-License-Identifier: Apache-2.0
"""The faults of a stereo depth camera, applied to true depth.

In the order in which they apply: near objects grow into the background (the halo of window matching); the left imager
sees areas that the right one does not (shadow on the left of near objects); pixels at edges take a depth between the
surfaces; disparity is noisy (smooth over the matching window, with a small part of each pixel) and quantised; points
that are too near, too far, at a grazing angle or not matched give 0.

Noise, its smoothness, the step of disparity and the halo follow measurements on recorded frames of a real camera.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.special import ndtri

from geometry.kernels.bundles import plain
from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import Camera
from geometry.rendering.kernel_camera import camera_of
from shared.camera import Intrinsics

STEP_BASE_M, STEP_SHARE = 0.03, 0.04
"""Two pixels belong to different surfaces if the farther exceeds the nearer by this length plus this share of it."""

GAUSS_BITS = 16
"""Bits of the index of the table of normal quantiles: it ends at 4.3 standard deviations."""

SIGMA_STEP_M, SIGMA_END_M = 0.005, 20.0
"""Step and end of the table of standard deviations over depth; beyond its end the last value holds."""

PERSISTENT_SHARE = 0.8
"""Constant share of the variance of the fields of holes and ragged borders: a surface without texture keeps its hole,
which flickers."""


_LOW_64 = 0xFFFF_FFFF_FFFF_FFFF


class DepthNoise(BaseModel):
    """Faults and their strengths; the defaults are those of a D435i. A fault is off if its value is 0."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    sigma_at_m: tuple[float, ...] = Field(
        default=(0.85, 1.25, 1.75, 2.5, 3.5, 5.0),
        min_length=1,
        description="Depths of the table of noise; between them it is a power of depth, beyond them it grows with z².",
    )
    sigma_m: tuple[float, ...] = Field(
        default=(0.0048, 0.0087, 0.021, 0.033, 0.096, 0.162),
        min_length=1,
        description="Standard deviation of depth at these depths, in metres, as measured on a real camera.",
    )
    sigma_gain: float = Field(default=1.0, ge=0.0, le=10.0, description="Factor on the table; 0 is no noise.")
    sigma_focal_px: float | None = Field(
        default=None,
        gt=0.0,
        description="Focal length (with 50 mm between the imagers) for which the table holds: noise is then constant "
        "in disparity, so a coarser camera is noisier. The recorded camera's was 430. None: the table holds for all.",
    )
    pixel_share: float = Field(
        default=0.1, ge=0.0, le=1.0, description="Share of the noise's variance that is independent for each pixel."
    )
    smooth_px: int = Field(default=8, ge=1, le=64, description="Pixels over which the rest of the noise is smooth.")
    disparity_step_px: float = Field(default=1.0 / 32.0, ge=0.0, le=1.0, description="Quantum of disparity.")
    disparity_max_px: float = Field(
        default=126.0, ge=0.0, le=512.0, description="Largest disparity searched; nearer points are not measured."
    )
    range_max_m: float = Field(default=10.0, ge=0.0, le=60.0, description="Largest depth measured, in metres.")
    halo_m: float = Field(default=0.03, ge=0.0, le=0.2, description="Width by which near objects grow, in metres.")
    halo_ragged: float = Field(default=0.4, ge=0.0, le=1.0, description="Share by which the halo's width varies.")
    flying_share: float = Field(
        default=0.3, ge=0.0, le=1.0, description="Share of the pixels at an edge that lie between the surfaces."
    )
    flying_px: int = Field(
        default=2, ge=1, le=4, description="Largest distance of flying pixels from an edge, in pixels."
    )
    shadow: bool = Field(default=True, description="No depth in areas that only the left imager sees.")
    grazing_from_deg: float = Field(
        default=80.0, ge=0.0, le=90.0, description="Incidence above which pixels fail, all of them at 90; 90 is off."
    )
    hole_share: float = Field(default=0.01, ge=0.0, le=0.5, description="Share of the image in holes.")
    hole_px: int = Field(default=12, ge=1, le=64, description="Size of holes; they are twice as wide as high.")

    @model_validator(mode="after")
    def _table_is_sound(self) -> DepthNoise:
        if len(self.sigma_at_m) != len(self.sigma_m):
            raise ValueError(f"sigma_m: expected {len(self.sigma_at_m)} values as in sigma_at_m")
        if min(self.sigma_at_m) <= 0.0 or min(self.sigma_m) <= 0.0:
            raise ValueError("sigma_at_m, sigma_m: expected values above 0; sigma_gain 0 is no noise")
        if any(low >= high for low, high in pairwise(self.sigma_at_m)):
            raise ValueError("sigma_at_m: expected rising depths")
        return self

    @classmethod
    def none(cls) -> DepthNoise:
        """Return a perfect camera, except for the rounding to its depth unit."""
        return cls(
            sigma_gain=0.0, disparity_step_px=0.0, disparity_max_px=0.0, range_max_m=0.0, halo_m=0.0, flying_share=0.0,
            shadow=False, grazing_from_deg=90.0, hole_share=0.0,
        )  # fmt: skip

    def sigma_of(self, z_m: NDArray[np.float64], intrinsics: Intrinsics) -> NDArray[np.float64]:
        """Return the standard deviation in metres of measured depth at true depths `z_m` > 0."""
        at_m, sigma_m = np.array(self.sigma_at_m), np.array(self.sigma_m)
        # Divided by z², the table is nearly flat, and constant beyond its ends.
        level = np.interp(np.log(z_m), np.log(at_m), np.log(sigma_m / at_m**2))
        gain = self.sigma_gain
        if self.sigma_focal_px is not None:
            gain *= self.sigma_focal_px * 0.05 / (intrinsics.stereo_focal_px * intrinsics.stereo_baseline_m)
        return np.asarray(gain * np.exp(level) * z_m**2)


class Faults(NamedTuple):
    """Faults of `measure`: the parameters of `DepthNoise` in the form of its computation.

    `focal_baseline` is in px·m. A pixel's deviation is the weighted sum of its own noise and the smooth noise. Holes
    are the pixels whose field is above `hole_level`.
    """

    focal_baseline: float
    depth_scale_m: float
    pixel_weight: float
    smooth_weight: float
    disparity_step_px: float
    disparity_max_px: float
    range_max_m: float
    flying_share: float
    flying_px: int
    shadow: bool
    grazing_cos: float
    hole_level: float


class Chance(NamedTuple):
    """Random inputs of a frame: `smooth` and `blobs` (H, W) of unit variance, the table `gauss`, and a `key`."""

    smooth: NDArray[np.float32]
    blobs: NDArray[np.float32]
    gauss: NDArray[np.float32]
    key: np.uint64


class Sides(NamedTuple):
    """Increase of a surface's depth over one pixel, to the left and right, and above and below."""

    from_left: float
    to_right: float
    from_above: float
    to_below: float


class DepthSensor:
    """Turn the view of a perfect camera into the image of a depth camera."""

    def __init__(self, intrinsics: Intrinsics, noise: DepthNoise, seed: int) -> None:
        self._intrinsics = intrinsics
        self._noise = noise
        self._key = np.uint64(mix(np.uint64(seed & _LOW_64)))
        height, width = intrinsics.shape
        depths_m = np.arange(SIGMA_STEP_M, SIGMA_END_M, SIGMA_STEP_M)
        sigma_m = np.concatenate(([0.0], noise.sigma_of(depths_m, intrinsics)))
        self._sigma_m = sigma_m.astype(np.float32)
        self._gauss = gauss_table()
        self._noise_grid = _grid(height, width, noise.smooth_px, noise.smooth_px)
        self._hole_grid = _grid(height, width, noise.hole_px, 2 * noise.hole_px)
        self._lasting_grid = np.empty_like(self._hole_grid)
        fill_gauss(self._lasting_grid, self._key, self._gauss)
        self._smooth = np.empty(intrinsics.shape, dtype=np.float32)
        self._blobs = np.zeros(intrinsics.shape, dtype=np.float32)
        self._grown_m = np.empty(intrinsics.shape, dtype=np.float32)

    def measure(self, z_m: NDArray[np.float32], moment: int) -> NDArray[np.uint16]:
        """Measure true depth `z_m` (H, W) float32 (inf: none) as depth (H, W) uint16 in units of `depth_scale_m`.

        `moment` is any integer that identifies the frame: equal moments of equally seeded sensors have equal noise.
        """
        noise, camera = self._noise, self._intrinsics
        # Mixed twice, so that no moment of one seed equals a moment of another.
        key = np.uint64(mix(np.uint64(mix(self._key ^ np.uint64(moment & _LOW_64)))))
        fill_gauss(self._noise_grid, key, self._gauss)
        smooth_field(self._noise_grid, noise.smooth_px, noise.smooth_px, self._smooth)
        if noise.hole_share or noise.halo_m:
            fill_gauss(self._hole_grid, np.uint64(mix(key)), self._gauss)
            self._hole_grid *= math.sqrt(1.0 - PERSISTENT_SHARE)
            self._hole_grid += math.sqrt(PERSISTENT_SHARE) * self._lasting_grid
            smooth_field(self._hole_grid, noise.hole_px, 2 * noise.hole_px, self._blobs)
        self._grown_m[:] = z_m
        if noise.halo_m:
            grow_near(z_m, self._blobs, noise.halo_m * camera.fx, noise.halo_ragged, self._grown_m)
        depth = np.empty(camera.shape, dtype=np.uint16)
        faults = Faults(
            focal_baseline=camera.stereo_focal_px * camera.stereo_baseline_m,
            depth_scale_m=camera.depth_scale_m,
            pixel_weight=math.sqrt(noise.pixel_share),
            smooth_weight=math.sqrt(1.0 - noise.pixel_share),
            disparity_step_px=noise.disparity_step_px,
            disparity_max_px=noise.disparity_max_px or np.inf,
            range_max_m=noise.range_max_m or np.inf,
            flying_share=noise.flying_share,
            flying_px=noise.flying_px,
            shadow=noise.shadow,
            grazing_cos=math.cos(math.radians(noise.grazing_from_deg)),
            hole_level=float(ndtri(1.0 - noise.hole_share)),
        )
        chance = plain(Chance(self._smooth, self._blobs, self._gauss, key))
        measure(self._grown_m, chance, self._sigma_m, camera_of(camera), plain(faults), depth)
        return depth


def _grid(height: int, width: int, rows_px: int, columns_px: int) -> NDArray[np.float32]:
    """Allocate the nodes of a field over an image."""
    return np.empty((height // rows_px + 2, width // columns_px + 2), dtype=np.float32)


@cache
def gauss_table() -> NDArray[np.float32]:
    """Return quantiles of the normal distribution: a random entry is a normal number."""
    count = 1 << GAUSS_BITS
    return np.asarray(ndtri((np.arange(count) + 0.5) / count), dtype=np.float32)


@kernel
def mix(key: np.uint64) -> np.uint64:
    """Return a 64-bit number in which each bit depends on all bits of `key` (splitmix64, Steele et al. 2014)."""
    x = key + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@kernel
def fill_gauss(grid: NDArray[np.float32], key: np.uint64, gauss: NDArray[np.float32]) -> None:
    """Fill `grid` with independent normal numbers that depend only on `key`."""
    rows, columns = grid.shape
    for i in range(rows):
        for j in range(columns):
            bits = mix(key + np.uint64(i * columns + j))
            grid[i, j] = gauss[bits >> np.uint64(64 - GAUSS_BITS)]


@kernel
def smooth_field(grid: NDArray[np.float32], rows_px: int, columns_px: int, field: NDArray[np.float32]) -> None:
    """Interpolate `grid`, nodes of unit variance, linearly over `field` (H, W), with unit variance everywhere."""
    height, width = field.shape
    columns = grid.shape[1]
    row = np.empty(columns, dtype=np.float32)
    share_x = np.empty(columns_px, dtype=np.float32)
    gain_x = np.empty(columns_px, dtype=np.float32)
    for j in range(columns_px):
        share = j / columns_px
        share_x[j] = share
        gain_x[j] = 1.0 / math.sqrt(share * share + (1.0 - share) * (1.0 - share))
    for y in range(height):
        i = y // rows_px
        share = (y - i * rows_px) / rows_px
        gain = np.float32(1.0 / math.sqrt(share * share + (1.0 - share) * (1.0 - share)))
        below = np.float32(share)
        for j in range(columns):
            row[j] = gain * (grid[i, j] + below * (grid[i + 1, j] - grid[i, j]))
        for j in range(columns - 1):
            first = j * columns_px
            for k in range(min(columns_px, width - first)):
                field[y, first + k] = gain_x[k] * (row[j] + share_x[k] * (row[j + 1] - row[j]))


@kernel
def grow_near(
    z_m: NDArray[np.float32],
    ragged_field: NDArray[np.float32],
    halo_px_m: float,
    ragged: float,
    grown_m: NDArray[np.float32],
) -> None:
    """Grow near surfaces by `halo_px_m / z` pixels over the background at their edges, at their own depth.

    `grown_m` (H, W) holds a copy of `z_m` on entry. The width varies by the share `ragged` for each unit of
    `ragged_field` (H, W), at most two.
    """
    height, width = z_m.shape
    for y in range(height):
        for x in range(width):
            z = z_m[y, x]
            behind = np.float32(z * (1.0 + STEP_SHARE) + STEP_BASE_M)
            farthest = max(
                max(z_m[y, max(x - 1, 0)], z_m[y, min(x + 1, width - 1)]),
                max(z_m[max(y - 1, 0), x], z_m[min(y + 1, height - 1), x]),
            )
            if not farthest > behind:
                continue
            reach = halo_px_m / z
            widest = int(reach * (1.0 + ragged))
            for row in range(max(y - widest, 0), min(y + widest, height - 1) + 1):
                for column in range(max(x - widest, 0), min(x + widest, width - 1) + 1):
                    if z_m[row, column] > behind and z < grown_m[row, column]:
                        distance2 = (row - y) * (row - y) + (column - x) * (column - x)
                        share = min(max(0.5 * ragged_field[row, column], -1.0), 1.0)
                        here = reach * (1.0 + ragged * share)
                        if distance2 <= here * here:
                            grown_m[row, column] = z


@kernel
def measure(
    z_m: NDArray[np.float32],
    chance: Chance,
    sigma_m: NDArray[np.float32],
    camera: Camera,
    faults: Faults,
    depth: NDArray[np.uint16],
) -> None:
    """Measure the surfaces at `z_m` (H, W) float32 metres (inf: none) into `depth` (H, W).

    `sigma_m` is over depth in steps of `SIGMA_STEP_M`.
    """
    smooth, blobs, gauss, key = Chance(*chance)
    camera, faults = Camera(*camera), Faults(*faults)
    fx, fy, cx, cy, width, height = camera
    focal_baseline, depth_scale_m = faults.focal_baseline, faults.depth_scale_m
    flying_below = np.uint64(faults.flying_share * 65536.0)
    raw_max = 65535.0 * depth_scale_m
    sigma_last = len(sigma_m) - 1
    low16 = np.uint64(0xFFFF)
    for y in range(height):
        # The leftmost column of the right imager that shows any point to the right of here.
        leftmost = np.inf
        ray_y = (y - cy) / fy
        for x in range(width - 1, -1, -1):
            depth[y, x] = 0
            z = float(z_m[y, x])
            if z == np.inf:
                continue
            disparity = focal_baseline / z
            if faults.shadow:
                seen_at = x - disparity
                if seen_at >= leftmost:
                    continue
                leftmost = seen_at
            if blobs[y, x] > faults.hole_level:
                continue
            bits = mix(key + np.uint64(y * width + x))
            gauss_bits = bits & low16
            flying_bits = (bits >> np.uint64(16)) & low16
            between_bits = (bits >> np.uint64(32)) & low16
            grazing_bits = bits >> np.uint64(48)
            if faults.grazing_cos > 0.0:
                left, right = z_m[y, max(x - 1, 0)], z_m[y, min(x + 1, width - 1)]
                above, below = z_m[max(y - 1, 0), x], z_m[min(y + 1, height - 1), x]
                # The flatter side: the other may be an edge.
                slope_x = fx * min(abs(z - left), abs(z - right))
                slope_y = fy * min(abs(z - above), abs(z - below))
                if slope_x * slope_x + slope_y * slope_y > 4.0 * z * z:
                    sides = Sides(z - left, right - z, z - above, below - z)
                    cos = incidence_cos(z, sides, camera, (x - cx) / fx, ray_y)
                    if cos * 65536.0 < faults.grazing_cos * grazing_bits:
                        continue
            if flying_bits < flying_below:
                nearest, farthest = z, z
                for k in range(1, faults.flying_px + 1):
                    for other in (
                        z_m[y, max(x - k, 0)],
                        z_m[y, min(x + k, width - 1)],
                        z_m[max(y - k, 0), x],
                        z_m[min(y + k, height - 1), x],
                    ):
                        nearest = min(nearest, other)
                        farthest = max(farthest, other)
                if farthest > nearest * (1.0 + STEP_SHARE) + STEP_BASE_M:
                    share = between_bits / 65536.0
                    disparity = share * (focal_baseline / nearest) + (1.0 - share) * (focal_baseline / farthest)
                    if disparity <= 0.0:
                        continue
                    z = focal_baseline / disparity
            sigma = sigma_m[min(int(z * (1.0 / SIGMA_STEP_M) + 0.5), sigma_last)]
            deviation = faults.pixel_weight * gauss[gauss_bits] + faults.smooth_weight * smooth[y, x]
            disparity += deviation * sigma * disparity / z
            if faults.disparity_step_px > 0.0:
                disparity = faults.disparity_step_px * np.rint(disparity / faults.disparity_step_px)
            if disparity <= 0.0 or disparity > faults.disparity_max_px:
                continue
            measured = focal_baseline / disparity
            if measured <= faults.range_max_m and measured <= raw_max:
                depth[y, x] = np.uint16(measured / depth_scale_m + 0.5)


@kernel
def incidence_cos(z: float, sides: Sides, camera: Camera, ray_x: float, ray_y: float) -> float:
    """Return the cosine between a pixel's ray (ray_x, ray_y, 1) and the normal of its surface, from depth differences.

    A plane's 1/z is linear on the screen, and its gradient there gives the normal. So the differences are taken over
    the flatter side, one pixel wide.
    """
    from_left, to_right, from_above, to_below = sides
    dx = from_left if abs(from_left) < abs(to_right) else to_right
    dy = from_above if abs(from_above) < abs(to_below) else to_below
    normal_x = -camera.fx * dx / z
    normal_y = -camera.fy * dy / z
    normal_z = 1.0 - ray_x * normal_x - ray_y * normal_y
    length = math.sqrt((normal_x**2 + normal_y**2 + normal_z**2) * (ray_x**2 + ray_y**2 + 1.0))
    return 1.0 / length
