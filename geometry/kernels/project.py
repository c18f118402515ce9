# SPDX-License-Identifier: Apache-2.0
"""Where meshes come to lie on the screen.

Conventions are those of `pinhole`. Corners are rounded to `1 / SUBPIXELS` of a pixel, so that what is drawn of them can
be reckoned without rounding. `camera` (5,) is fx, fy, cx, cy in pixels and the near plane in metres.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import moved, project, rows_of_32

SUBPIXELS = np.float32(512.0)
"""Corners are off by a thousandth of a pixel at most; a depth camera cannot tell half a pixel."""

SUBPIXEL = np.float32(1.0 / 512.0)


@kernel
def rounded(u_or_v: np.float32) -> np.float32:
    """A pixel coordinate in whole subpixels."""
    return np.float32(np.rint(u_or_v * SUBPIXELS) * SUBPIXEL)


@kernel
def place_vertices(
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    offset_x: NDArray[np.float32],
    offset_y: NDArray[np.float32],
    offset_z: NDArray[np.float32],
    padding_m: np.float32,
    T_camera_mesh: NDArray[np.float64],
    camera: NDArray[np.float32],
    u_px: NDArray[np.float32],
    v_px: NDArray[np.float32],
    w_per_m: NDArray[np.float32],
) -> int:
    """Vertices to the screen; returns how many lie before the near plane.

    Written for the vectoriser: one type, no branch, each coordinate in its own array.
    """
    rows = rows_of_32(T_camera_mesh)
    fx, fy, cx, cy, near_m = camera[0], camera[1], camera[2], camera[3], camera[4]
    one = np.float32(1.0)
    before = 0
    for i in range(len(x_m)):
        px = x_m[i] + padding_m * offset_x[i]
        py = y_m[i] + padding_m * offset_y[i]
        pz = z_m[i] + padding_m * offset_z[i]
        x, y, z = moved(rows, px, py, pz)
        w = one / max(z, near_m)
        u, v = project(x, y, w, fx, fy, cx, cy)
        u_px[i], v_px[i], w_per_m[i] = rounded(u), rounded(v), w
        before += z < near_m
    return before


@kernel
def bring_vertices(
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    offset_x: NDArray[np.float32],
    offset_y: NDArray[np.float32],
    offset_z: NDArray[np.float32],
    padding_m: np.float32,
    T_camera_mesh: NDArray[np.float64],
    camera_x_m: NDArray[np.float32],
    camera_y_m: NDArray[np.float32],
    camera_z_m: NDArray[np.float32],
) -> None:
    """Vertices to the camera frame, reckoned as `place_vertices` does: only a mesh that is cut needs them there."""
    rows = rows_of_32(T_camera_mesh)
    for i in range(len(x_m)):
        px = x_m[i] + padding_m * offset_x[i]
        py = y_m[i] + padding_m * offset_y[i]
        pz = z_m[i] + padding_m * offset_z[i]
        camera_x_m[i], camera_y_m[i], camera_z_m[i] = moved(rows, px, py, pz)


@kernel
def bound(
    u_px: NDArray[np.float32], v_px: NDArray[np.float32], width: int, height: int, rectangle: NDArray[np.int32]
) -> None:
    """Set `rectangle` (4,) to the pixels within the bounds of some points; in integers, which the vectoriser can."""
    left, top = np.int32(width), np.int32(height)
    right, bottom = np.int32(-1), np.int32(-1)
    for i in range(len(u_px)):
        left = min(left, np.int32(np.ceil(u_px[i])))
        right = max(right, np.int32(np.floor(u_px[i])))
        top = min(top, np.int32(np.ceil(v_px[i])))
        bottom = max(bottom, np.int32(np.floor(v_px[i])))
    zero = np.int32(0)
    rectangle[0], rectangle[1] = max(top, zero), min(bottom, np.int32(height - 1))
    rectangle[2], rectangle[3] = max(left, zero), min(right, np.int32(width - 1))
    if rectangle[0] > rectangle[1] or rectangle[2] > rectangle[3]:
        rectangle[0], rectangle[1], rectangle[2], rectangle[3] = height, -1, width, -1


@kernel
def clip(corners: NDArray[np.float32], camera: NDArray[np.float32], polygon: NDArray[np.float64]) -> int:
    """Cut a triangle with corners (3, 3) in the camera frame at the near plane; returns how many corners are left.

    Out: `polygon` (4, 3), their pixel coordinates and inverse depth; a triangle cut by a plane has up to four.
    """
    fx, fy, cx, cy, near_m = camera[0], camera[1], camera[2], camera[3], camera[4]
    count = 0
    for i in range(3):
        j = (i + 1) % 3
        z_i = corners[i, 2]
        z_j = corners[j, 2]
        if z_i >= near_m:
            # Reckoned as `place_vertices` does: a neighbour that is not cut has the same corners.
            w = np.float32(1.0) / z_i
            u, v = project(corners[i, 0], corners[i, 1], w, fx, fy, cx, cy)
            polygon[count, 0], polygon[count, 1], polygon[count, 2] = rounded(u), rounded(v), w
            count += 1
        if (z_i >= near_m) != (z_j >= near_m):
            # Always from the end in front, so that a neighbour that is cut too finds the same point.
            front, back = (i, j) if z_i >= near_m else (j, i)
            share = (near_m - corners[front, 2]) / (corners[back, 2] - corners[front, 2])
            x = corners[front, 0] + share * (corners[back, 0] - corners[front, 0])
            y = corners[front, 1] + share * (corners[back, 1] - corners[front, 1])
            w = np.float32(1.0) / near_m
            polygon[count, 0], polygon[count, 1] = project(x, y, w, fx, fy, cx, cy)
            polygon[count, 2] = w
            count += 1
    return count


@kernel
def corners_of(
    i: int,
    j: int,
    k: int,
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    corners: NDArray[np.float32],
) -> None:
    """The corners (3, 3) of a triangle."""
    corners[0, 0], corners[0, 1], corners[0, 2] = x_m[i], y_m[i], z_m[i]
    corners[1, 0], corners[1, 1], corners[1, 2] = x_m[j], y_m[j], z_m[j]
    corners[2, 0], corners[2, 1], corners[2, 2] = x_m[k], y_m[k], z_m[k]


@kernel
def bound_cut(
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    camera: NDArray[np.float32],
    width: int,
    height: int,
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    rectangle: NDArray[np.int32],
) -> None:
    """`bound` for a mesh that the near plane cuts: of what is left of its triangles."""
    left, top, right, bottom = 1e9, 1e9, -1.0, -1.0
    for f in range(len(a)):
        corners_of(a[f], b[f], c[f], x_m, y_m, z_m, corners)
        for n in range(clip(corners, camera, polygon)):
            left, right = min(left, polygon[n, 0]), max(right, polygon[n, 0])
            top, bottom = min(top, polygon[n, 1]), max(bottom, polygon[n, 1])
    rectangle[0], rectangle[1] = math.ceil(max(top, 0.0)), math.floor(min(bottom, height - 1.0))
    rectangle[2], rectangle[3] = math.ceil(max(left, 0.0)), math.floor(min(right, width - 1.0))
    if rectangle[0] > rectangle[1] or rectangle[2] > rectangle[3]:
        rectangle[0], rectangle[1], rectangle[2], rectangle[3] = height, -1, width, -1


@kernel
def place_meshes(
    vertices_m: NDArray[np.float32],
    offsets: NDArray[np.float32],
    faces: NDArray[np.int32],
    vertex_starts: NDArray[np.int32],
    face_starts: NDArray[np.int32],
    chosen: NDArray[np.bool_],
    T_camera_mesh: NDArray[np.float64],
    padding_m: NDArray[np.float32],
    camera: NDArray[np.float32],
    width: int,
    height: int,
    placed: NDArray[np.float32],
    before: NDArray[np.int32],
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    rectangles: NDArray[np.int32],
) -> None:
    """Bring the `chosen` (M,) of M meshes to the screen, each with its pose and padding.

    They lie one after the other in `vertices_m` (3, V) and `faces` (3, F): mesh m has the vertices
    `vertex_starts[m]:vertex_starts[m + 1]` and likewise faces, whose indices count from the mesh's own first vertex.
    A vertex is placed at `vertex + padding_m[m] * offset`, with `offsets` (3, V). `T_camera_mesh` (M, 4, 4).

    Out: `placed` (6, V), pixel coordinates, inverse depth, and, of a mesh that the near plane cuts, coordinates in the
    camera frame; `before` (M,), how many of the vertices lie before the near plane; `rectangles` (M, 4), the pixels
    that a mesh may touch: first and last row, first and last column, empty (first > last) where it is not in view.
    Scratch: `corners` (3, 3), `polygon` (4, 3).
    """
    for m in range(len(chosen)):
        if not chosen[m]:
            continue
        first, end = vertex_starts[m], vertex_starts[m + 1]
        x_m, y_m, z_m = vertices_m[0, first:end], vertices_m[1, first:end], vertices_m[2, first:end]
        # Where nothing is added, nothing need be fetched from memory: any numbers that are there will do.
        added = offsets if padding_m[m] != 0.0 else vertices_m
        offset_x, offset_y, offset_z = added[0, first:end], added[1, first:end], added[2, first:end]
        u_px, v_px, w_per_m = placed[0, first:end], placed[1, first:end], placed[2, first:end]
        before[m] = place_vertices(
            x_m, y_m, z_m, offset_x, offset_y, offset_z, padding_m[m], T_camera_mesh[m], camera, u_px, v_px, w_per_m
        )  # fmt: skip
        if before[m] == 0:
            bound(u_px, v_px, width, height, rectangles[m])
        else:
            camera_x_m, camera_y_m, camera_z_m = placed[3, first:end], placed[4, first:end], placed[5, first:end]
            bring_vertices(
                x_m, y_m, z_m, offset_x, offset_y, offset_z, padding_m[m], T_camera_mesh[m],
                camera_x_m, camera_y_m, camera_z_m,
            )  # fmt: skip
            a, b, c = faces[0], faces[1], faces[2]
            start, stop = face_starts[m], face_starts[m + 1]
            bound_cut(
                a[start:stop], b[start:stop], c[start:stop], camera_x_m, camera_y_m, camera_z_m,
                camera, width, height, corners, polygon, rectangles[m],
            )  # fmt: skip
