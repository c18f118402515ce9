# SPDX-License-Identifier: Apache-2.0
"""Projection of points into the image; all kernels use this one.

Camera frames are optical: x to the right, y down, z forward. `T_a_b` (4, 4) maps points of frame b into frame a.
Pixel centres are at integer coordinates: pixel (u, v), column and row, extends from u - 0.5 to u + 0.5, and the image
from -0.5 to width - 0.5. `fx`, `fy`, `cx`, `cy` are in pixels. Points are in metres, or all in units of raw depth with
the translation of `T_a_b` in the same units, since only ratios matter. Inverse depth is `w = 1/z`, in 1/m or 1/raw.

Each function computes in the type of its arguments, is inlined, and has no branch, so loops around it are vectorised.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel

Real = TypeVar("Real", float, np.float32)
Real_co = TypeVar("Real_co", float, np.float32, covariant=True)

Rows: TypeAlias = tuple[Real, Real, Real, Real, Real, Real, Real, Real, Real, Real, Real, Real]
"""The first three rows of a rigid transform in sequence: as scalars they stay in registers."""


class Lens(Protocol[Real_co]):
    """Parameters of a projection: focal lengths and centre in pixels, in the type of the points."""

    @property
    def fx(self) -> Real_co: ...
    @property
    def fy(self) -> Real_co: ...
    @property
    def cx(self) -> Real_co: ...
    @property
    def cy(self) -> Real_co: ...


class Camera(NamedTuple):
    """A pinhole camera; all in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class Camera32(NamedTuple):
    """A `Camera` in float32."""

    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    width: int
    height: int


@kernel
def rows_of(T_a_b: NDArray[np.float64]) -> Rows[float]:
    """Return the rows of a transform (4, 4), for `moved`."""
    t = T_a_b
    return (
        t[0, 0], t[0, 1], t[0, 2], t[0, 3],
        t[1, 0], t[1, 1], t[1, 2], t[1, 3],
        t[2, 0], t[2, 1], t[2, 2], t[2, 3],
    )  # fmt: skip


@kernel
def rows_of_32(T_a_b: NDArray[np.float64]) -> Rows[np.float32]:
    """Return the rows of a transform (4, 4) in float32, for `moved`."""
    t = T_a_b
    return (
        np.float32(t[0, 0]), np.float32(t[0, 1]), np.float32(t[0, 2]), np.float32(t[0, 3]),
        np.float32(t[1, 0]), np.float32(t[1, 1]), np.float32(t[1, 2]), np.float32(t[1, 3]),
        np.float32(t[2, 0]), np.float32(t[2, 1]), np.float32(t[2, 2]), np.float32(t[2, 3]),
    )  # fmt: skip


@kernel
def moved(rows_a_b: Rows[Real], x: Real, y: Real, z: Real) -> tuple[Real, Real, Real]:
    """Map a point of frame b into frame a."""
    r = rows_a_b
    return (
        r[0] * x + r[1] * y + r[2] * z + r[3],
        r[4] * x + r[5] * y + r[6] * z + r[7],
        r[8] * x + r[9] * y + r[10] * z + r[11],
    )


@kernel
def in_32(camera: Camera) -> Camera32:
    """Return the camera in float32."""
    c = camera
    return Camera32(np.float32(c.fx), np.float32(c.fy), np.float32(c.cx), np.float32(c.cy), c.width, c.height)


@kernel
def project(x: Real, y: Real, w: Real, lens: Lens[Real]) -> tuple[Real, Real]:
    """Return pixel coordinates u and v of a point in the camera frame whose inverse depth is `w`."""
    return x * w * lens.fx + lens.cx, y * w * lens.fy + lens.cy


@kernel
def deproject(u: float, v: float, z: float, camera: Camera) -> tuple[float, float, float]:
    """Return the point in the camera frame at depth `z` and pixel coordinates u and v."""
    return (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z


@kernel
def nearest_pixel(u_or_v: Real) -> int:
    """Return the column or row whose centre is nearest to a pixel coordinate; the higher of two."""
    return np.int64(np.floor(u_or_v + np.float32(0.5)))  # type: ignore[return-value]  # to numba it is a plain number
