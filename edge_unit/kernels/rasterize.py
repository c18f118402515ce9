# SPDX-License-Identifier: Apache-2.0
"""Meshes onto the screen: a z-buffer of inverse depth (the paper's Algorithms 2 to 4).

What is linear on the screen is 1/z, not z; so the buffers hold `w = 1/z` (1/m): the nearest surface
has the largest w, and 0 means that nothing stands there. Pixel centres are at integer coordinates.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edge_unit.kernels.jit import kernel

NOTHING_NEAREST = np.float32(0.0)
"""`nearest_w` of a pixel without a surface: infinitely far."""

NOTHING_FARTHEST = np.float32(1e6)
"""`farthest_w` of a pixel without a surface: a micrometre away, so that any surface is farther. Not the largest
float32: its inverse is subnormal, which costs a hundred cycles a pixel."""


@kernel
def fill_triangle(
    u0: float,
    v0: float,
    w0: float,
    u1: float,
    v1: float,
    w1: float,
    u2: float,
    v2: float,
    w2: float,
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangle: NDArray[np.int32],
) -> None:
    """Draw one triangle given by pixel coordinates and inverse depth of its corners.

    Every pixel centre on or inside an edge is drawn, and the crossing of an edge with a row is reckoned from its
    upper end whichever triangle it belongs to: neighbours leave no gap. `rectangle` (4,) grows: first and
    last row, first and last column that may have been touched.
    """
    height, width = nearest_w.shape
    left = max(math.ceil(min(u0, u1, u2)), 0)
    right = min(math.floor(max(u0, u1, u2)), width - 1)
    top = max(math.ceil(min(v0, v1, v2)), 0)
    bottom = min(math.floor(max(v0, v1, v2)), height - 1)
    if left > right or top > bottom:
        return
    if v1 < v0:
        u0, v0, w0, u1, v1, w1 = u1, v1, w1, u0, v0, w0
    if v2 < v1:
        u1, v1, w1, u2, v2, w2 = u2, v2, w2, u1, v1, w1
        if v1 < v0:
            u0, v0, w0, u1, v1, w1 = u1, v1, w1, u0, v0, w0
    double_area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    if double_area == 0.0:
        return
    w_per_u = ((w1 - w0) * (v2 - v0) - (w2 - w0) * (v1 - v0)) / double_area
    w_per_v = ((w2 - w0) * (u1 - u0) - (w1 - w0) * (u2 - u0)) / double_area
    w_low = np.float32(min(w0, w1, w2))
    w_high = np.float32(max(w0, w1, w2))
    long_slope = (u2 - u0) / (v2 - v0)
    upper_slope = (u1 - u0) / (v1 - v0) if v1 > v0 else 0.0
    lower_slope = (u2 - u1) / (v2 - v1) if v2 > v1 else 0.0
    for y in range(top, bottom + 1):
        u_long = u0 + (y - v0) * long_slope
        u_short = u0 + (y - v0) * upper_slope if y < v1 else u1 + (y - v1) * lower_slope
        first = max(math.ceil(min(u_long, u_short)), left)
        last = min(math.floor(max(u_long, u_short)), right)
        if first > last:
            continue
        # A sliver's gradient is ill-conditioned: never leave the range of its corners.
        w_row = w0 + (y - v0) * w_per_v
        w = min(max(np.float32(w_row + (first - u0) * w_per_u), w_low), w_high)
        w_last = min(max(np.float32(w_row + (last - u0) * w_per_u), w_low), w_high)
        step = (w_last - w) / np.float32(max(last - first, 1))
        nearest_row = nearest_w[y]
        farthest_row = farthest_w[y]
        # Unsigned, for a signed index is tested for counting from the end.
        for x in range(np.uint64(first), np.uint64(last + 1)):
            nearest = nearest_row[x]
            farthest = farthest_row[x]
            nearest_row[x] = w if w > nearest else nearest
            farthest_row[x] = w if w < farthest else farthest
            w += step
    rectangle[0] = min(rectangle[0], top)
    rectangle[1] = max(rectangle[1], bottom)
    rectangle[2] = min(rectangle[2], left)
    rectangle[3] = max(rectangle[3], right)


@kernel
def fill_clipped(
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    cull: bool,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    near_m: float,
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangle: NDArray[np.int32],
) -> None:
    """Draw the part beyond the near plane of a triangle with corners (3, 3) in the camera frame.

    `polygon` (4, 3) is scratch: a triangle cut by a plane has up to four corners.
    """
    count = 0
    for i in range(3):
        j = (i + 1) % 3
        z_i = corners[i, 2]
        z_j = corners[j, 2]
        if z_i >= near_m:
            # Rounded as `draw_mesh` rounds them: a neighbour that is not cut has the same corners.
            w = 1.0 / z_i
            polygon[count, 0] = np.float32(corners[i, 0] * w * fx + cx)
            polygon[count, 1] = np.float32(corners[i, 1] * w * fy + cy)
            polygon[count, 2] = np.float32(w)
            count += 1
        if (z_i >= near_m) != (z_j >= near_m):
            # Always from the end in front, so that a neighbour that is cut too finds the same point.
            front, back = (i, j) if z_i >= near_m else (j, i)
            share = (near_m - corners[front, 2]) / (corners[back, 2] - corners[front, 2])
            x = corners[front, 0] + share * (corners[back, 0] - corners[front, 0])
            y = corners[front, 1] + share * (corners[back, 1] - corners[front, 1])
            polygon[count, 0] = x / near_m * fx + cx
            polygon[count, 1] = y / near_m * fy + cy
            polygon[count, 2] = 1.0 / near_m
            count += 1
    for i in range(1, count - 1):
        u0, v0 = polygon[0, 0], polygon[0, 1]
        u1, v1 = polygon[i, 0], polygon[i, 1]
        u2, v2 = polygon[i + 1, 0], polygon[i + 1, 1]
        if cull and (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0) >= 0.0:
            continue
        fill_triangle(
            u0, v0, polygon[0, 2],
            u1, v1, polygon[i, 2],
            u2, v2, polygon[i + 1, 2],
            nearest_w, farthest_w, rectangle,
        )  # fmt: skip


@kernel
def draw_mesh(
    vertices_m: NDArray[np.float32],
    offsets: NDArray[np.float32],
    faces: NDArray[np.int32],
    closed: bool,
    T_camera_mesh: NDArray[np.float32],
    padding_m: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    near_m: float,
    screen: NDArray[np.float32],
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangle: NDArray[np.int32],
) -> None:
    """Draw one mesh, inflated by `padding_m`, into the buffers of nearest and farthest inverse depth.

    `vertices_m` (V, 3) and `offsets` (V, 3) in the mesh's frame: a vertex is drawn at `vertex + padding_m * offset`.
    `faces` (F, 3); faces turned away are culled when the mesh is `closed` (Algorithm 3). `T_camera_mesh` (3, 4).
    Both buffers are (H, W) float32 of 1/m; `farthest_w` holds the farthest *drawn* surface. Scratch:
    `screen` (>= V, 6), `corners` (3, 3), `polygon` (4, 3). `rectangle` (4,) as in `fill_triangle`.
    """
    height, width = nearest_w.shape
    t = T_camera_mesh
    left, right, above, below, behind = 0, 0, 0, 0, 0
    count = len(vertices_m)
    for i in range(count):
        px = vertices_m[i, 0] + padding_m * offsets[i, 0]
        py = vertices_m[i, 1] + padding_m * offsets[i, 1]
        pz = vertices_m[i, 2] + padding_m * offsets[i, 2]
        x = t[0, 0] * px + t[0, 1] * py + t[0, 2] * pz + t[0, 3]
        y = t[1, 0] * px + t[1, 1] * py + t[1, 2] * pz + t[1, 3]
        z = t[2, 0] * px + t[2, 1] * py + t[2, 2] * pz + t[2, 3]
        w = 1.0 / max(z, near_m)
        u = x * w * fx + cx
        v = y * w * fy + cy
        screen[i, 0] = u
        screen[i, 1] = v
        screen[i, 2] = w
        screen[i, 3] = x
        screen[i, 4] = y
        screen[i, 5] = z
        if z < near_m:
            behind += 1
        else:
            left += u < 0.0
            right += u > width - 1
            above += v < 0.0
            below += v > height - 1
    if behind == count or (behind == 0 and (left == count or right == count or above == count or below == count)):
        return
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        if screen[a, 5] >= near_m and screen[b, 5] >= near_m and screen[c, 5] >= near_m:
            # In float64 as after clipping, so that neighbours agree on where their edge crosses a row.
            u0, v0 = np.float64(screen[a, 0]), np.float64(screen[a, 1])
            u1, v1 = np.float64(screen[b, 0]), np.float64(screen[b, 1])
            u2, v2 = np.float64(screen[c, 0]), np.float64(screen[c, 1])
            if closed and (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0) >= 0.0:
                continue
            fill_triangle(
                u0, v0, np.float64(screen[a, 2]),
                u1, v1, np.float64(screen[b, 2]),
                u2, v2, np.float64(screen[c, 2]),
                nearest_w, farthest_w, rectangle,
            )  # fmt: skip
        elif screen[a, 5] >= near_m or screen[b, 5] >= near_m or screen[c, 5] >= near_m:
            for k in range(3):
                corners[0, k] = screen[a, 3 + k]
                corners[1, k] = screen[b, 3 + k]
                corners[2, k] = screen[c, 3 + k]
            fill_clipped(corners, polygon, closed, fx, fy, cx, cy, near_m, nearest_w, farthest_w, rectangle)


@kernel
def draw_meshes(
    vertices_m: NDArray[np.float32],
    offsets: NDArray[np.float32],
    faces: NDArray[np.int32],
    vertex_starts: NDArray[np.int32],
    face_starts: NDArray[np.int32],
    closed: NDArray[np.bool_],
    T_camera_mesh: NDArray[np.float32],
    padding_m: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    near_m: float,
    screen: NDArray[np.float32],
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangles: NDArray[np.int32],
) -> None:
    """Draw M meshes that lie one after the other in `vertices_m` and `faces`, each with its pose and padding.

    Mesh m has the vertices `vertex_starts[m]:vertex_starts[m + 1]` and likewise faces, whose indices count from the
    mesh's own first vertex. `T_camera_mesh` (M, 3, 4), `padding_m` (M,), `closed` (M,). `rectangles` (M, 4) is
    set to the pixels that each mesh may have touched, empty (first > last) where it is not in view.
    """
    height, width = nearest_w.shape
    for m in range(len(closed)):
        rectangles[m, 0] = height
        rectangles[m, 1] = -1
        rectangles[m, 2] = width
        rectangles[m, 3] = -1
        first, last = vertex_starts[m], vertex_starts[m + 1]
        draw_mesh(
            vertices_m[first:last],
            offsets[first:last],
            faces[face_starts[m] : face_starts[m + 1]],
            closed[m],
            T_camera_mesh[m],
            padding_m[m],
            fx, fy, cx, cy, near_m,
            screen, corners, polygon,
            nearest_w, farthest_w, rectangles[m],
        )  # fmt: skip


@kernel
def clear_rectangles(
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangles: NDArray[np.int32],
) -> None:
    """Forget what was drawn inside the `rectangles` (M, 4): first and last row, first and last column."""
    for m in range(len(rectangles)):
        for y in range(rectangles[m, 0], rectangles[m, 1] + 1):
            for x in range(rectangles[m, 2], rectangles[m, 3] + 1):
                nearest_w[y, x] = NOTHING_NEAREST
                farthest_w[y, x] = NOTHING_FARTHEST
