# SPDX-License-Identifier: Apache-2.0
"""Meshes onto the screen: a z-buffer of inverse depth (the paper's Algorithms 2 to 4).

What is linear on the screen is 1/z, not z; so the buffers hold `w = 1/z` (1/m): the nearest surface
has the largest w, and 0 means that nothing stands there. Pixel centres are at integer coordinates.

Corners are rounded to `1 / SUBPIXELS` of a pixel. Small triangles, which are nearly all, are then drawn by edge
functions in integers, which never round, `LANES` pixels of a row at once. Large ones go span by span in float64.
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

LANES = 16
"""Pixels of a row that are drawn at once, whether they are needed or not; buffers are so much wider than the picture.
With fewer the compiler unrolls the loop before it could vectorise it."""

SUBPIXELS = np.float32(512.0)
"""Corners are off by a thousandth of a pixel at most; a depth camera cannot tell half a pixel."""

SUBPIXEL = np.float32(1.0 / 512.0)

SMALL_ROWS = 96
"""Triangles up to twice `LANES` wide and so many rows high are drawn with integers of 32 bits. An edge's function is
the difference of two products, at most (32 + 16) * 96 + 32 * 96 pixels in units of 1/512 squared: 2.01e9 of 2.15e9."""

UNSEEN, SMALL, WIDE, LARGE = 0, 1, 2, 3
"""What is done with a triangle: nothing, for it is turned away or holds no pixel centre; or how it is drawn: at once
when no wider than `LANES`, in two halves when no wider than twice that, or span by span."""


@kernel
def place_vertices(
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    offset_x: NDArray[np.float32],
    offset_y: NDArray[np.float32],
    offset_z: NDArray[np.float32],
    padding_m: np.float32,
    T_camera_mesh: NDArray[np.float32],
    fx: np.float32,
    fy: np.float32,
    cx: np.float32,
    cy: np.float32,
    near_m: np.float32,
    u_px: NDArray[np.float32],
    v_px: NDArray[np.float32],
    w_per_m: NDArray[np.float32],
    camera_x_m: NDArray[np.float32],
    camera_y_m: NDArray[np.float32],
    camera_z_m: NDArray[np.float32],
) -> int:
    """Vertices to the camera frame and to the screen; returns how many lie before the near plane.

    Written for the vectoriser: one type, no branch, each coordinate in its own array.
    """
    t = T_camera_mesh
    xx, xy, xz, x0 = t[0, 0], t[0, 1], t[0, 2], t[0, 3]
    yx, yy, yz, y0 = t[1, 0], t[1, 1], t[1, 2], t[1, 3]
    zx, zy, zz, z0 = t[2, 0], t[2, 1], t[2, 2], t[2, 3]
    one = np.float32(1.0)
    before = 0
    for i in range(len(x_m)):
        px = x_m[i] + padding_m * offset_x[i]
        py = y_m[i] + padding_m * offset_y[i]
        pz = z_m[i] + padding_m * offset_z[i]
        x = xx * px + xy * py + xz * pz + x0
        y = yx * px + yy * py + yz * pz + y0
        z = zx * px + zy * py + zz * pz + z0
        w = one / max(z, near_m)
        u_px[i] = np.rint((x * w * fx + cx) * SUBPIXELS) * SUBPIXEL
        v_px[i] = np.rint((y * w * fy + cy) * SUBPIXELS) * SUBPIXEL
        w_per_m[i] = w
        camera_x_m[i] = x
        camera_y_m[i] = y
        camera_z_m[i] = z
        before += z < near_m
    return before


@kernel
def sort_faces(
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    u_px: NDArray[np.float32],
    v_px: NDArray[np.float32],
    closed: bool,
    last_column: np.float32,
    last_row: np.float32,
    kinds: NDArray[np.uint8],
) -> None:
    """What is to be done with each triangle, all of whose corners lie beyond the near plane.

    Written for the vectoriser: no branch. Faces turned away are left out when the mesh is `closed` (Algorithm 3).
    """
    zero, width, height = np.float32(0.0), np.float32(LANES - 1), np.float32(SMALL_ROWS - 1)
    twice = np.float32(2 * LANES - 1)
    for f in range(len(a)):
        i, j, k = np.uint32(a[f]), np.uint32(b[f]), np.uint32(c[f])
        u0, u1, u2 = u_px[i], u_px[j], u_px[k]
        v0, v1, v2 = v_px[i], v_px[j], v_px[k]
        left, right = min(u0, min(u1, u2)), max(u0, max(u1, u2))
        top, bottom = min(v0, min(v1, v2)), max(v0, max(v1, v2))
        holds_column = np.ceil(max(left, zero)) <= np.floor(min(right, last_column))
        holds_row = np.ceil(max(top, zero)) <= np.floor(min(bottom, last_row))
        double_area = np.float64(u1 - u0) * np.float64(v2 - v0) - np.float64(u2 - u0) * np.float64(v1 - v0)
        turned_here = (double_area < 0.0) | ((not closed) & (double_area > 0.0))
        seen = holds_column & holds_row & turned_here
        low = bottom - top <= height
        narrow, wide = low & (right - left <= width), low & (right - left <= twice)
        # UNSEEN and one more for each step; a choice between constants would not be vectorised.
        kinds[f] = np.uint8(seen) + np.uint8(seen & (not narrow)) + np.uint8(seen & (not wide))


@kernel
def sort_cut_faces(
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    camera_z_m: NDArray[np.float32],
    near_m: np.float32,
    kinds: NDArray[np.uint8],
) -> None:
    """Mend `kinds` where a corner lies before the near plane: such a triangle is cut, or not seen at all."""
    for f in range(len(a)):
        beyond = 0
        beyond += camera_z_m[a[f]] >= near_m
        beyond += camera_z_m[b[f]] >= near_m
        beyond += camera_z_m[c[f]] >= near_m
        if beyond < 3:
            kinds[f] = LARGE if beyond > 0 else UNSEEN


@kernel
def list_faces(
    kinds: NDArray[np.uint8], small: NDArray[np.int32], wide: NDArray[np.int32], large: NDArray[np.int32]
) -> tuple[int, int, int]:
    """The numbers of the small and wide, of the wide, and of the large triangles; returns how many of each."""
    # Unsigned, for a signed index is tested for counting from the end.
    smalls, wides, larges = np.uint64(0), np.uint64(0), np.uint64(0)
    for f in range(len(kinds)):
        # Written always and kept when it is one: a branch would be guessed wrong too often.
        small[smalls] = f
        wide[wides] = f
        large[larges] = f
        kind = kinds[f]
        smalls += np.uint64((kind == SMALL) | (kind == WIDE))
        wides += np.uint64(kind == WIDE)
        larges += np.uint64(kind == LARGE)
    # To numba they are plain numbers.
    return np.int64(smalls), np.int64(wides), np.int64(larges)  # type: ignore[return-value]


@kernel
def fill_small(
    faces: NDArray[np.int32],
    from_column: np.float32,
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    u_px: NDArray[np.float32],
    v_px: NDArray[np.float32],
    w_per_m: NDArray[np.float32],
    width: int,
    height: int,
    stride: int,
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangle: NDArray[np.int32],
) -> None:
    """Draw `LANES` columns, from each one's column `from_column` on, of the triangles whose numbers are `faces`.

    A pixel is drawn when its centre is on the inner side of all three edges, or on one: neighbours leave no gap, for
    integers do not round. `nearest_w` and `farthest_w` are flat, `stride` to a row. `rectangle` (4,) as in
    `draw_meshes`.
    """
    zero = np.float32(0.0)
    last_column, last_row = np.float32(width - 1), np.float32(height - 1)
    pixel = np.int32(SUBPIXELS)
    first_row, end_row, first_column, end_column = rectangle[0], rectangle[1], rectangle[2], rectangle[3]
    for n in range(len(faces)):
        f = np.uint32(faces[n])
        i, j, k = np.uint32(a[f]), np.uint32(b[f]), np.uint32(c[f])
        u0, u1, u2 = u_px[i], u_px[j], u_px[k]
        v0, v1, v2 = v_px[i], v_px[j], v_px[k]
        w0, w1, w2 = w_per_m[i], w_per_m[j], w_per_m[k]
        u_left = np.ceil(max(min(u0, min(u1, u2)), zero)) + from_column
        v_top = np.ceil(max(min(v0, min(v1, v2)), zero))
        left, top = np.int32(u_left), np.int32(v_top)
        right = np.int32(min(max(u0, max(u1, u2)), last_column))
        # The picture's edge may have cut off the columns that are asked for.
        bottom = np.int32(min(max(v0, max(v1, v2)), last_row)) if left <= right else top - 1
        # From here on in subpixels from the first pixel.
        x0, y0 = np.int32((u0 - u_left) * SUBPIXELS), np.int32((v0 - v_top) * SUBPIXELS)
        x1, y1 = np.int32((u1 - u_left) * SUBPIXELS), np.int32((v1 - v_top) * SUBPIXELS)
        x2, y2 = np.int32((u2 - u_left) * SUBPIXELS), np.int32((v2 - v_top) * SUBPIXELS)
        double_area = np.int32((x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0))
        turn = np.int32(1) if double_area > 0 else np.int32(-1)
        # Each edge's function, positive inside: its change by a subpixel to the right and down, and its start.
        per_x_0, per_y_0 = np.int32((y0 - y1) * turn), np.int32((x1 - x0) * turn)
        per_x_1, per_y_1 = np.int32((y1 - y2) * turn), np.int32((x2 - x1) * turn)
        per_x_2, per_y_2 = np.int32((y2 - y0) * turn), np.int32((x0 - x2) * turn)
        edge_0 = np.int32(-x0 * per_x_0 - y0 * per_y_0)
        edge_1 = np.int32(-x1 * per_x_1 - y1 * per_y_1)
        edge_2 = np.int32(-x2 * per_x_2 - y2 * per_y_2)
        per_x_0, per_x_1, per_x_2 = np.int32(per_x_0 * pixel), np.int32(per_x_1 * pixel), np.int32(per_x_2 * pixel)
        per_y_0, per_y_1, per_y_2 = np.int32(per_y_0 * pixel), np.int32(per_y_1 * pixel), np.int32(per_y_2 * pixel)
        per_area = SUBPIXELS * SUBPIXELS / np.float32(double_area)
        w_per_u = ((w1 - w0) * (v2 - v0) - (w2 - w0) * (v1 - v0)) * per_area
        w_per_v = ((w2 - w0) * (u1 - u0) - (w1 - w0) * (u2 - u0)) * per_area
        # A sliver's gradient is ill-conditioned: never leave the range of its corners.
        w_low, w_high = min(w0, min(w1, w2)), max(w0, max(w1, w2))
        w = w0 + (u_left - u0) * w_per_u + (v_top - v0) * w_per_v
        at = np.uint64(top * stride + left)
        for _ in range(bottom - top + 1):
            # Two loops, each with one array: with two in one, the vectoriser would have to ask whether they overlap.
            for lane in range(LANES):
                x = np.int32(lane)
                outside = (
                    np.int32(edge_0 + x * per_x_0) | np.int32(edge_1 + x * per_x_1) | np.int32(edge_2 + x * per_x_2)
                )
                here = min(max(w + np.float32(x) * w_per_u, w_low), w_high)
                before = nearest_w[at + np.uint64(lane)]
                nearest_w[at + np.uint64(lane)] = here if (outside >= 0) & (here > before) else before
            for lane in range(LANES):
                x = np.int32(lane)
                outside = (
                    np.int32(edge_0 + x * per_x_0) | np.int32(edge_1 + x * per_x_1) | np.int32(edge_2 + x * per_x_2)
                )
                here = min(max(w + np.float32(x) * w_per_u, w_low), w_high)
                before = farthest_w[at + np.uint64(lane)]
                farthest_w[at + np.uint64(lane)] = here if (outside >= 0) & (here < before) else before
            edge_0, edge_1, edge_2 = np.int32(edge_0 + per_y_0), np.int32(edge_1 + per_y_1), np.int32(edge_2 + per_y_2)
            w += w_per_v
            at += np.uint64(stride)
        first_row, end_row = min(first_row, top), max(end_row, bottom)
        first_column, end_column = min(first_column, left), max(end_column, right)
    rectangle[0], rectangle[1], rectangle[2], rectangle[3] = first_row, end_row, first_column, end_column


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
    width: int,
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangle: NDArray[np.int32],
) -> None:
    """Draw one triangle of any size, given by pixel coordinates and inverse depth of its corners.

    Every pixel centre on or inside an edge is drawn, and the crossing of an edge with a row is reckoned from its
    upper end whichever triangle it belongs to: neighbours leave no gap. `rectangle` (4,) grows: first and
    last row, first and last column that may have been touched.
    """
    height = len(nearest_w)
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
        nearest_row = nearest_w[y, first : last + 1]
        for x in range(len(nearest_row)):
            here = w + np.float32(x) * step
            nearest_row[x] = here if here > nearest_row[x] else nearest_row[x]
        farthest_row = farthest_w[y, first : last + 1]
        for x in range(len(farthest_row)):
            here = w + np.float32(x) * step
            farthest_row[x] = here if here < farthest_row[x] else farthest_row[x]
    rectangle[0] = min(rectangle[0], top)
    rectangle[1] = max(rectangle[1], bottom)
    rectangle[2] = min(rectangle[2], left)
    rectangle[3] = max(rectangle[3], right)


@kernel
def fill_clipped(
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    cull: bool,
    fx: np.float32,
    fy: np.float32,
    cx: np.float32,
    cy: np.float32,
    near_m: np.float32,
    width: int,
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
            # Reckoned as `place_vertices` does: a neighbour that is not cut has the same corners.
            w = np.float32(1.0) / z_i
            polygon[count, 0] = np.rint((corners[i, 0] * w * fx + cx) * SUBPIXELS) * SUBPIXEL
            polygon[count, 1] = np.rint((corners[i, 1] * w * fy + cy) * SUBPIXELS) * SUBPIXEL
            polygon[count, 2] = w
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
            width, nearest_w, farthest_w, rectangle,
        )  # fmt: skip


@kernel
def draw_mesh(
    vertices_m: NDArray[np.float32],
    offsets: NDArray[np.float32],
    faces: NDArray[np.int32],
    first_vertex: int,
    end_vertex: int,
    first_face: int,
    end_face: int,
    closed: bool,
    T_camera_mesh: NDArray[np.float32],
    padding_m: np.float32,
    fx: np.float32,
    fy: np.float32,
    cx: np.float32,
    cy: np.float32,
    near_m: np.float32,
    width: int,
    placed: NDArray[np.float32],
    kinds: NDArray[np.uint8],
    lists: NDArray[np.int32],
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangle: NDArray[np.int32],
) -> None:
    """Draw one of the meshes of `draw_meshes`."""
    count = end_vertex - first_vertex
    u_px, v_px, w_per_m = placed[0, :count], placed[1, :count], placed[2, :count]
    x_m, y_m, z_m = placed[3, :count], placed[4, :count], placed[5, :count]
    before = place_vertices(
        vertices_m[0, first_vertex:end_vertex],
        vertices_m[1, first_vertex:end_vertex],
        vertices_m[2, first_vertex:end_vertex],
        offsets[0, first_vertex:end_vertex],
        offsets[1, first_vertex:end_vertex],
        offsets[2, first_vertex:end_vertex],
        padding_m, T_camera_mesh, fx, fy, cx, cy, near_m,
        u_px, v_px, w_per_m, x_m, y_m, z_m,
    )  # fmt: skip
    if before == count:
        return
    height, stride = nearest_w.shape
    a, b, c = faces[0, first_face:end_face], faces[1, first_face:end_face], faces[2, first_face:end_face]
    kind = kinds[: len(a)]
    sort_faces(a, b, c, u_px, v_px, closed, np.float32(width - 1), np.float32(height - 1), kind)
    if before > 0:
        sort_cut_faces(a, b, c, z_m, near_m, kind)
    smalls, wides, larges = list_faces(kind, lists[0], lists[1], lists[2])
    flat_nearest_w, flat_farthest_w = nearest_w.reshape(-1), farthest_w.reshape(-1)
    fill_small(
        lists[0, :smalls], np.float32(0.0), a, b, c, u_px, v_px, w_per_m, width, height, stride,
        flat_nearest_w, flat_farthest_w, rectangle,
    )  # fmt: skip
    fill_small(
        lists[1, :wides], np.float32(LANES), a, b, c, u_px, v_px, w_per_m, width, height, stride,
        flat_nearest_w, flat_farthest_w, rectangle,
    )  # fmt: skip
    for n in range(larges):
        f = lists[2, n]
        i, j, k = a[f], b[f], c[f]
        if z_m[i] >= near_m and z_m[j] >= near_m and z_m[k] >= near_m:
            # In float64 as after clipping, so that neighbours agree on where their edge crosses a row.
            fill_triangle(
                np.float64(u_px[i]), np.float64(v_px[i]), np.float64(w_per_m[i]),
                np.float64(u_px[j]), np.float64(v_px[j]), np.float64(w_per_m[j]),
                np.float64(u_px[k]), np.float64(v_px[k]), np.float64(w_per_m[k]),
                width, nearest_w, farthest_w, rectangle,
            )  # fmt: skip
        else:
            corners[0, 0], corners[0, 1], corners[0, 2] = x_m[i], y_m[i], z_m[i]
            corners[1, 0], corners[1, 1], corners[1, 2] = x_m[j], y_m[j], z_m[j]
            corners[2, 0], corners[2, 1], corners[2, 2] = x_m[k], y_m[k], z_m[k]
            fill_clipped(corners, polygon, closed, fx, fy, cx, cy, near_m, width, nearest_w, farthest_w, rectangle)


@kernel
def draw_meshes(
    vertices_m: NDArray[np.float32],
    offsets: NDArray[np.float32],
    faces: NDArray[np.int32],
    vertex_starts: NDArray[np.int32],
    face_starts: NDArray[np.int32],
    closed: NDArray[np.bool_],
    chosen: NDArray[np.bool_],
    T_camera_mesh: NDArray[np.float32],
    padding_m: NDArray[np.float32],
    fx: np.float32,
    fy: np.float32,
    cx: np.float32,
    cy: np.float32,
    near_m: np.float32,
    width: int,
    placed: NDArray[np.float32],
    kinds: NDArray[np.uint8],
    lists: NDArray[np.int32],
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangles: NDArray[np.int32],
) -> None:
    """Draw the `chosen` (M,) of M meshes, each with its pose and padding, into nearest and farthest inverse depth.

    They lie one after the other in `vertices_m` (3, V) and `faces` (3, F): mesh m has the vertices
    `vertex_starts[m]:vertex_starts[m + 1]` and likewise faces, whose indices count from the mesh's own first vertex.
    A vertex is drawn at `vertex + padding_m[m] * offset`, with `offsets` (3, V). Faces turned away are left out where a
    mesh is `closed` (M,) (Algorithm 3). `T_camera_mesh` (M, 3, 4).

    The buffers (H, at least width + LANES) are float32 of 1/m; what lies beyond `width` means nothing. `farthest_w` is
    of the farthest *drawn* surface. `rectangles` (M, 4) of the chosen are set to the pixels that each may have touched,
    first and last row, first and last column, empty (first > last) where it is not in view.
    Scratch: `placed` (6, most vertices of a mesh), `kinds` (most faces,), `lists` (3, most faces + 1),
    `corners` (3, 3), `polygon` (4, 3).
    """
    for m in range(len(closed)):
        if not chosen[m]:
            continue
        rectangles[m, 0] = len(nearest_w)
        rectangles[m, 1] = -1
        rectangles[m, 2] = width
        rectangles[m, 3] = -1
        draw_mesh(
            vertices_m, offsets, faces,
            vertex_starts[m], vertex_starts[m + 1], face_starts[m], face_starts[m + 1],
            closed[m], T_camera_mesh[m], padding_m[m],
            fx, fy, cx, cy, near_m, width,
            placed, kinds, lists, corners, polygon,
            nearest_w, farthest_w, rectangles[m],
        )  # fmt: skip


@kernel
def copy_rectangles(
    rectangles: NDArray[np.int32],
    chosen: NDArray[np.bool_],
    from_nearest_w: NDArray[np.float32],
    from_farthest_w: NDArray[np.float32],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
) -> None:
    """Copy what was drawn inside the `chosen` (M,) of the `rectangles` (M, 4)."""
    for m in range(len(rectangles)):
        first, end = rectangles[m, 2], rectangles[m, 3] + 1
        if chosen[m]:
            for y in range(rectangles[m, 0], rectangles[m, 1] + 1):
                nearest_w[y, first:end] = from_nearest_w[y, first:end]
                farthest_w[y, first:end] = from_farthest_w[y, first:end]


@kernel
def clear_rectangles(
    rectangles: NDArray[np.int32],
    chosen: NDArray[np.bool_],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
) -> None:
    """Forget what was drawn inside the `chosen` (M,) of the `rectangles` (M, 4)."""
    for m in range(len(rectangles)):
        first, end = rectangles[m, 2], rectangles[m, 3] + 1
        if chosen[m]:
            for y in range(rectangles[m, 0], rectangles[m, 1] + 1):
                nearest_w[y, first:end] = NOTHING_NEAREST
                farthest_w[y, first:end] = NOTHING_FARTHEST
