# SPDX-License-Identifier: Apache-2.0
"""The voxel grid of the cell: world-aligned, one for all units.

A voxel's key is `(ix * ny + iy) * nz + iz` as a little-endian uint32. Units send keys and the master merges them.
Indices are floored, never truncated or rounded (the paper's Algorithm 1 adds half a *length* to a dimensionless
number). So a point on a border belongs to the voxel with the higher index.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.errors import InputError

MAX_CELLS = 2**27
"""Limit of voxels: a dense counter of uint32 then takes at most 512 MiB of address space on a unit."""

MAX_AXIS = 2**15 - 1
"""Limit of an axis: indices travel as int16."""

MAX_INDEX = 2.0**53
"""Limit of an index: below it, a float64 distinguishes neighbouring integers."""

NUMBERS, INTEGERS = "iuf", "iu"
"""Kinds of numpy dtypes accepted as numbers and as integers: no text, objects or booleans; fractions are not cut."""

SHOWN_CHARS = 60
"""Maximum length of a quoted value: enough to recognise it."""

MAX_BLOCKS = 2**17
"""Limit of blocks in a cell: 16 kB of uncompressed seen bits, and 128 KiB of the master's memory for each unit."""

EDGE_TOLERANCE = 1e-6
"""Tolerance of a count of voxels: 3.0 m at 0.1 m has 30 voxels, though a floating-point quotient may exceed 30."""


@dataclass(frozen=True)
class Lattice:
    """Voxels of edge `voxel_size_m`, starting at the corner `origin_m` (3,) in the world; `shape` counts each axis."""

    origin_m: tuple[float, float, float]
    voxel_size_m: float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        corner = _numbers(self.origin_m, "lattice origin_m", "three finite numbers")
        if corner.shape != (3,) or not np.isfinite(corner).all():
            raise InputError(f"lattice origin_m: expected three finite numbers, got {_shown(self.origin_m)}")
        size = _length(self.voxel_size_m, "lattice voxel_size_m")
        wanted = f"three counts of 1 to {MAX_AXIS}"
        counts = _numbers(self.shape, "lattice shape", wanted, INTEGERS)
        if counts.shape != (3,) or counts.min() < 1 or counts.max() > MAX_AXIS:
            raise InputError(f"lattice shape: expected {wanted}, got {_shown(self.shape)}")
        origin = tuple(float(value) for value in corner)
        shape = tuple(int(count) for count in counts)
        if int(np.prod(shape, dtype=np.int64)) > MAX_CELLS:
            raise InputError(
                f"lattice of {shape[0]} x {shape[1]} x {shape[2]} voxels of {size} m: "
                f"expected at most {MAX_CELLS}, choose larger voxels or a smaller box"
            )
        object.__setattr__(self, "origin_m", origin)
        object.__setattr__(self, "voxel_size_m", size)
        object.__setattr__(self, "shape", shape)

    @classmethod
    def covering(cls, box_min_m: ArrayLike, box_max_m: ArrayLike, voxel_size_m: float) -> Lattice:
        """Return the smallest lattice from `box_min_m` that covers the box up to `box_max_m`.

        Raises:
            InputError: the box is empty, needs more than `MAX_CELLS` voxels, or is not given as finite numbers.
        """
        low = _numbers(box_min_m, "box_min_m", "three finite numbers").astype(np.float64)
        high = _numbers(box_max_m, "box_max_m", "three finite numbers").astype(np.float64)
        if low.shape != (3,) or high.shape != (3,) or not (high > low).all() or not np.isfinite((low, high)).all():
            raise InputError(f"box: expected min below max on three axes, got {low.tolist()} to {high.tolist()}")
        size = _length(voxel_size_m, "voxel_size_m")
        with np.errstate(over="ignore"):
            counts = np.ceil((high - low) / size - EDGE_TOLERANCE)
        # 2**53 fits an int64; the constructor refuses any count near it.
        counts = np.clip(counts, 1, 2**53).astype(np.int64)
        return cls(
            (float(low[0]), float(low[1]), float(low[2])),
            size,
            (int(counts[0]), int(counts[1]), int(counts[2])),
        )

    @property
    def cell_count(self) -> int:
        """The number of voxels."""
        nx, ny, nz = self.shape
        return nx * ny * nz

    def index(self, points_m: NDArray[Any]) -> NDArray[np.int64]:
        """Return the indices (..., 3) of the voxels that contain world points (..., 3) in metres, not clipped.

        Raises:
            InputError: `points_m` are not points of three finite numbers.
        """
        points = _triples(points_m, "points_m", NUMBERS)
        with np.errstate(over="ignore"):
            found = np.floor((points - self.origin_m) / self.voxel_size_m)
        if not (np.abs(found) < MAX_INDEX).all():
            raise InputError("points_m: expected finite numbers within reach of the lattice, got NaN, infinity or more")
        return found.astype(np.int64)

    def contains(self, indices: NDArray[Any]) -> NDArray[np.bool_]:
        """Return (...) bool: True for the indices (..., 3) that lie on the lattice.

        Raises:
            InputError: `indices` are not triples of numbers.
        """
        found = _triples(indices, "indices", NUMBERS)
        return np.asarray(((found >= 0) & (found < self.shape)).all(axis=-1))

    def centres(self, indices: NDArray[Any]) -> NDArray[np.float64]:
        """Return the centres (..., 3) in metres, world frame, of the voxels at `indices` (..., 3).

        Raises:
            InputError: `indices` are not triples of numbers.
        """
        return (
            np.asarray(self.origin_m)
            + (_triples(indices, "indices", NUMBERS).astype(np.float64) + 0.5) * self.voxel_size_m
        )

    def keys(self, indices: NDArray[Any]) -> NDArray[np.uint32]:
        """Return the keys (N,) of indices (N, 3), in the same order.

        Raises:
            InputError: an index lies outside the lattice, or `indices` are not triples of integers.
        """
        found = _triples(indices, "indices", INTEGERS).astype(np.int64)
        if found.ndim != 2:
            raise InputError(f"indices: expected shape (N, 3), got {found.shape}")
        if not self.contains(found).all():
            raise InputError(f"indices: expected 0 <= index < {self.shape}, got some outside")
        _, ny, nz = self.shape
        return ((found[:, 0] * ny + found[:, 1]) * nz + found[:, 2]).astype("<u4")

    def indices(self, keys: NDArray[Any]) -> NDArray[np.int16]:
        """Return the indices (N, 3) int16 of keys (N,).

        Raises:
            InputError: a key lies outside the lattice, or `keys` are not integers.
        """
        found = _numbers(keys, "keys", "integers", INTEGERS).astype(np.int64).reshape(-1)
        if found.size and (found.min() < 0 or found.max() >= self.cell_count):
            raise InputError(f"keys: expected 0 <= key < {self.cell_count}, got {found.min()} to {found.max()}")
        _, ny, nz = self.shape
        return np.stack((found // (ny * nz), found // nz % ny, found % nz), axis=-1).astype(np.int16)


def block_lattice(box_min_m: NDArray[np.float64], box_max_m: NDArray[np.float64], block_size_m: float) -> Lattice:
    """Return the lattice of blocks, in which units report what they see through, of a box.

    The box spans `box_min_m` (3,) to `box_max_m` (3,). The block size doubles until there are at most `MAX_BLOCKS`.

    Raises:
        InputError: as in `Lattice.covering`.
    """
    while np.ceil((box_max_m - box_min_m) / block_size_m).prod() > MAX_BLOCKS:
        block_size_m *= 2.0
    return Lattice.covering(box_min_m, box_max_m, block_size_m)


def _numbers(value: ArrayLike, name: str, expected: str, kinds: str = NUMBERS) -> NDArray[Any]:
    """Return `value` as an array whose dtype is of one of `kinds`; accept an empty list, whose dtype is arbitrary."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected {expected}, got {_shown(value)}") from error
    if array.dtype.kind not in kinds and not (array.size == 0 and array.dtype.kind in NUMBERS):
        raise InputError(f"{name}: expected {expected}, got {_shown(value)}")
    return array


def _triples(value: ArrayLike, name: str, kinds: str) -> NDArray[Any]:
    """Return `value` as an array (..., 3)."""
    array = _numbers(value, name, "integers" if kinds == INTEGERS else "numbers", kinds)
    if array.shape[-1:] != (3,):
        raise InputError(f"{name}: expected three values on the last axis, got shape {array.shape}")
    return array


def _length(value: float, name: str) -> float:
    """Return `value` as a positive, finite float."""
    array = _numbers(value, name, "a positive length")
    if array.shape != () or not (np.isfinite(array) and array > 0.0):
        raise InputError(f"{name}: expected a positive length, got {_shown(value)}")
    return float(array)


def _shown(value: object) -> str:
    """Return `value` in one short line."""
    return " ".join(repr(value).split())[:SHOWN_CHARS]
