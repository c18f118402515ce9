# SPDX-License-Identifier: Apache-2.0
"""The voxel grid of the cell: world-aligned, one for all units.

A voxel's key is `(ix * ny + iy) * nz + iz` as a little-endian uint32: what units send and the master merges.
Indices are floored, never truncated or rounded (the paper's Algorithm 1 adds half a *length* to a
dimensionless number); so a point on a border belongs to the voxel above it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.errors import InputError

MAX_CELLS = 2**27
"""A dense counter of uint32 then takes at most 512 MiB of address space on a unit."""

MAX_AXIS = 2**15 - 1
"""Indices travel as int16."""

EDGE_TOLERANCE = 1e-6
"""A box of 3.0 m at 0.1 m has 30 voxels, although 3.0 / 0.1 is 30.000000000000004 in floating point."""


@dataclass(frozen=True)
class Lattice:
    """Voxels of edge `voxel_size_m` from the corner `origin_m` (3,) of the world; `shape` counts them per axis."""

    origin_m: tuple[float, float, float]
    voxel_size_m: float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        origin = tuple(float(value) for value in self.origin_m)
        shape = tuple(int(count) for count in self.shape)
        if len(origin) != 3 or not np.isfinite(origin).all():
            raise InputError(f"lattice origin_m: expected three finite numbers, got {self.origin_m}")
        if not (np.isfinite(self.voxel_size_m) and self.voxel_size_m > 0.0):
            raise InputError(f"lattice voxel_size_m: expected a positive length, got {self.voxel_size_m}")
        if len(shape) != 3 or min(shape) < 1 or max(shape) > MAX_AXIS:
            raise InputError(f"lattice shape: expected three counts of 1 to {MAX_AXIS}, got {self.shape}")
        if int(np.prod(shape, dtype=np.int64)) > MAX_CELLS:
            raise InputError(
                f"lattice of {shape[0]} x {shape[1]} x {shape[2]} voxels of {self.voxel_size_m} m: "
                f"expected at most {MAX_CELLS}, choose larger voxels or a smaller box"
            )
        object.__setattr__(self, "origin_m", origin)
        object.__setattr__(self, "voxel_size_m", float(self.voxel_size_m))
        object.__setattr__(self, "shape", shape)

    @classmethod
    def covering(cls, box_min_m: ArrayLike, box_max_m: ArrayLike, voxel_size_m: float) -> Lattice:
        """The smallest lattice from `box_min_m` that covers the box up to `box_max_m`.

        Raises:
            InputError: the box is empty, or it would need more than `MAX_CELLS` voxels.
        """
        low = np.asarray(box_min_m, dtype=np.float64)
        high = np.asarray(box_max_m, dtype=np.float64)
        if low.shape != (3,) or high.shape != (3,) or not (high > low).all() or not np.isfinite((low, high)).all():
            raise InputError(f"box: expected min below max on three axes, got {low.tolist()} to {high.tolist()}")
        if not voxel_size_m > 0.0:
            raise InputError(f"voxel_size_m: expected a positive length, got {voxel_size_m}")
        counts = np.ceil((high - low) / voxel_size_m - EDGE_TOLERANCE)
        # Both ends fit an int64; a number of voxels near the upper one is refused below.
        counts = np.clip(counts, 1, 2**53).astype(np.int64)
        return cls(
            (float(low[0]), float(low[1]), float(low[2])),
            voxel_size_m,
            (int(counts[0]), int(counts[1]), int(counts[2])),
        )

    @property
    def cell_count(self) -> int:
        """How many voxels there are."""
        nx, ny, nz = self.shape
        return nx * ny * nz

    def index(self, points_m: NDArray[Any]) -> NDArray[np.int64]:
        """Indices (..., 3) of the voxels that hold the world points (..., 3) in metres; not clipped to the shape."""
        return np.floor((np.asarray(points_m) - self.origin_m) / self.voxel_size_m).astype(np.int64)

    def contains(self, indices: NDArray[Any]) -> NDArray[np.bool_]:
        """Which of the indices (..., 3) lie on the lattice, (...) bool."""
        found = np.asarray(indices)
        return np.asarray(((found >= 0) & (found < self.shape)).all(axis=-1))

    def centres(self, indices: NDArray[Any]) -> NDArray[np.float64]:
        """World positions (..., 3) in metres of the middles of the voxels at `indices` (..., 3)."""
        return np.asarray(self.origin_m) + (np.asarray(indices, dtype=np.float64) + 0.5) * self.voxel_size_m

    def keys(self, indices: NDArray[Any]) -> NDArray[np.uint32]:
        """Keys (N,) of indices (N, 3), in the order given.

        Raises:
            InputError: an index lies outside the lattice.
        """
        found = np.asarray(indices, dtype=np.int64).reshape(-1, 3)
        if not self.contains(found).all():
            raise InputError(f"indices: expected 0 <= index < {self.shape}, got some outside")
        _, ny, nz = self.shape
        return ((found[:, 0] * ny + found[:, 1]) * nz + found[:, 2]).astype("<u4")

    def indices(self, keys: NDArray[Any]) -> NDArray[np.int16]:
        """Indices (N, 3) int16 of keys (N,).

        Raises:
            InputError: a key lies outside the lattice.
        """
        found = np.asarray(keys, dtype=np.int64).reshape(-1)
        if found.size and (found.min() < 0 or found.max() >= self.cell_count):
            raise InputError(f"keys: expected 0 <= key < {self.cell_count}, got {found.min()} to {found.max()}")
        _, ny, nz = self.shape
        return np.stack((found // (ny * nz), found // nz % ny, found % nz), axis=-1).astype(np.int16)
