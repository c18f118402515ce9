# SPDX-License-Identifier: Apache-2.0
"""Meshes onto the screen: a z-buffer of inverse depth (the paper's Algorithms 2 to 4).

What is linear on the screen is 1/z, not z; so the buffers hold `w = 1/z` (1/m): the nearest surface
has the largest w, and 0 means that nothing stands there. Pixel centres are at integer coordinates.

A buffer holds only a *window* of the picture, the rectangle about all that is drawn: thirty times a second it comes
from cold memory, where few pages in a row are fetched several times as fast as many scattered ones. Window (4,):
first row, first column, rows, and columns with those that `LANES` may run over; a buffer is flat.

Small triangles, which are nearly all, are drawn by edge functions in integers, which never round, `LANES` pixels of a
row at once. Large ones go span by span in float64.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edge_unit.kernels.jit import kernel
from edge_unit.kernels.project import SUBPIXELS, clip, corners_of, place_meshes

NOTHING_NEAREST = np.float32(0.0)
"""`nearest_w` of a pixel without a surface: infinitely far."""

NOTHING_FARTHEST = np.float32(1e6)
"""`farthest_w` of a pixel without a surface: a micrometre away, so that any surface is farther. Not the largest
float32: its inverse is subnormal, which costs a hundred cycles a pixel."""

LANES = 16
"""Pixels of a row that are drawn at once, whether they are needed or not; buffers are so much wider than the picture.
With fewer the compiler unrolls the loop before it could vectorise it."""

SMALL_ROWS = 96
"""Triangles up to twice `LANES` wide and so many rows high are drawn with integers of 32 bits. An edge's function is
the difference of two products, at most (32 + 16) * 96 + 32 * 96 pixels in units of 1/512 squared: 2.01e9 of 2.15e9."""

UNSEEN, SMALL, WIDE, LARGE = 0, 1, 2, 3
"""What is done with a triangle: nothing, for it is turned away or holds no pixel centre; or how it is drawn: at once
when no wider than `LANES`, in two halves when no wider than twice that, or span by span."""


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
    window: NDArray[np.int64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
) -> None:
    """Draw `LANES` columns, from each one's column `from_column` on, of the triangles whose numbers are `faces`.

    A pixel is drawn when its centre is on the inner side of all three edges, or on one: neighbours leave no gap, for
    integers do not round.
    """
    zero = np.float32(0.0)
    last_column, last_row = np.float32(width - 1), np.float32(height - 1)
    pixel = np.int32(SUBPIXELS)
    first_row, first_column, stride = window[0], window[1], window[3]
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
        at = np.uint64((top - first_row) * stride + left - first_column)
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
    height: int,
    window: NDArray[np.int64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
) -> None:
    """Draw one triangle of any size, given by pixel coordinates and inverse depth of its corners.

    Every pixel centre on or inside an edge is drawn, and the crossing of an edge with a row is reckoned from its
    upper end whichever triangle it belongs to: neighbours leave no gap.
    """
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
        at = (y - window[0]) * window[3] + first - window[1]
        nearest_row = nearest_w[at : at + last + 1 - first]
        for x in range(len(nearest_row)):
            here = w + np.float32(x) * step
            nearest_row[x] = here if here > nearest_row[x] else nearest_row[x]
        farthest_row = farthest_w[at : at + last + 1 - first]
        for x in range(len(farthest_row)):
            here = w + np.float32(x) * step
            farthest_row[x] = here if here < farthest_row[x] else farthest_row[x]


@kernel
def fill_clipped(
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    cull: bool,
    camera: NDArray[np.float32],
    width: int,
    height: int,
    window: NDArray[np.int64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
) -> None:
    """Draw what lies beyond the near plane of a triangle with corners (3, 3) in the camera frame; `polygon` (4, 3)."""
    for i in range(1, clip(corners, camera, polygon) - 1):
        u0, v0 = polygon[0, 0], polygon[0, 1]
        u1, v1 = polygon[i, 0], polygon[i, 1]
        u2, v2 = polygon[i + 1, 0], polygon[i + 1, 1]
        if cull and (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0) >= 0.0:
            continue
        fill_triangle(
            u0, v0, polygon[0, 2],
            u1, v1, polygon[i, 2],
            u2, v2, polygon[i + 1, 2],
            width, height, window, nearest_w, farthest_w,
        )  # fmt: skip


@kernel
def fill_mesh(
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    closed: bool,
    before: int,
    u_px: NDArray[np.float32],
    v_px: NDArray[np.float32],
    w_per_m: NDArray[np.float32],
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    camera: NDArray[np.float32],
    width: int,
    height: int,
    window: NDArray[np.int64],
    kinds: NDArray[np.uint8],
    lists: NDArray[np.int32],
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
) -> None:
    """Draw one of the meshes of `draw_meshes`, `before` of whose vertices lie before the near plane."""
    near_m = camera[4]
    sort_faces(a, b, c, u_px, v_px, closed, np.float32(width - 1), np.float32(height - 1), kinds)
    if before > 0:
        sort_cut_faces(a, b, c, z_m, near_m, kinds)
    smalls, wides, larges = list_faces(kinds, lists[0], lists[1], lists[2])
    fill_small(
        lists[0, :smalls], np.float32(0.0), a, b, c, u_px, v_px, w_per_m, width, height, window, nearest_w, farthest_w
    )  # fmt: skip
    fill_small(
        lists[1, :wides], np.float32(LANES), a, b, c, u_px, v_px, w_per_m, width, height, window, nearest_w, farthest_w
    )  # fmt: skip
    for n in range(larges):
        f = lists[2, n]
        i, j, k = a[f], b[f], c[f]
        if before > 0 and (z_m[i] < near_m or z_m[j] < near_m or z_m[k] < near_m):
            corners_of(i, j, k, x_m, y_m, z_m, corners)
            fill_clipped(corners, polygon, closed, camera, width, height, window, nearest_w, farthest_w)
        else:
            # In float64 as after clipping, so that neighbours agree on where their edge crosses a row.
            fill_triangle(
                np.float64(u_px[i]), np.float64(v_px[i]), np.float64(w_per_m[i]),
                np.float64(u_px[j]), np.float64(v_px[j]), np.float64(w_per_m[j]),
                np.float64(u_px[k]), np.float64(v_px[k]), np.float64(w_per_m[k]),
                width, height, window, nearest_w, farthest_w,
            )  # fmt: skip


@kernel
def span_of_row(
    y: int, rectangles: NDArray[np.int32], chosen: NDArray[np.bool_], others: NDArray[np.bool_]
) -> tuple[int, int]:
    """First column and the one after the last of `rectangles` (M, 4) in row y, of the `chosen` and the `others` (M,).

    (0, 0) when there is none.
    """
    first, end = 0, 0
    for m in range(len(rectangles)):
        if (chosen[m] or others[m]) and rectangles[m, 0] <= y <= rectangles[m, 1]:
            first = min(first, rectangles[m, 2]) if end > 0 else rectangles[m, 2]
            end = max(end, rectangles[m, 3] + 1)
    return first, end


@kernel
def open_window(
    rectangles: NDArray[np.int32],
    chosen: NDArray[np.bool_],
    others: NDArray[np.bool_],
    window: NDArray[np.int64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
) -> None:
    """Lay the `window` about the `rectangles` (M, 4) of the `chosen` and the `others` (M,); clear what they reach."""
    first_row, last_row, first_column, last_column = 2**30, -1, 2**30, -1
    for m in range(len(rectangles)):
        if (chosen[m] or others[m]) and rectangles[m, 0] <= rectangles[m, 1]:
            first_row, last_row = min(first_row, rectangles[m, 0]), max(last_row, rectangles[m, 1])
            first_column, last_column = min(first_column, rectangles[m, 2]), max(last_column, rectangles[m, 3])
    if last_row < 0:
        window[:] = 0
        return
    window[0], window[1] = first_row, first_column
    window[2], window[3] = last_row - first_row + 1, last_column - first_column + 1 + LANES
    for y in range(first_row, last_row + 1):
        first, end = span_of_row(y, rectangles, chosen, others)
        at = (y - first_row) * window[3] - first_column
        nearest_w[at + first : at + end] = NOTHING_NEAREST
        farthest_w[at + first : at + end] = NOTHING_FARTHEST


@kernel
def copy_window(
    rectangles: NDArray[np.int32],
    chosen: NDArray[np.bool_],
    from_window: NDArray[np.int64],
    from_nearest_w: NDArray[np.float32],
    from_farthest_w: NDArray[np.float32],
    window: NDArray[np.int64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
) -> None:
    """Copy what the `chosen` (M,) of the `rectangles` (M, 4) reach from one window to another, which encloses it."""
    for y in range(from_window[0], from_window[0] + from_window[2]):
        first, end = span_of_row(y, rectangles, chosen, chosen)
        source = (y - from_window[0]) * from_window[3] - from_window[1]
        at = (y - window[0]) * window[3] - window[1]
        nearest_w[at + first : at + end] = from_nearest_w[source + first : source + end]
        farthest_w[at + first : at + end] = from_farthest_w[source + first : source + end]


@kernel
def draw_meshes(
    vertices_m: NDArray[np.float32],
    offsets: NDArray[np.float32],
    faces: NDArray[np.int32],
    vertex_starts: NDArray[np.int32],
    face_starts: NDArray[np.int32],
    closed: NDArray[np.bool_],
    chosen: NDArray[np.bool_],
    others: NDArray[np.bool_],
    T_camera_mesh: NDArray[np.float64],
    padding_m: NDArray[np.float32],
    camera: NDArray[np.float32],
    width: int,
    height: int,
    placed: NDArray[np.float32],
    before: NDArray[np.int32],
    kinds: NDArray[np.uint8],
    lists: NDArray[np.int32],
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    kept_window: NDArray[np.int64],
    kept_nearest_w: NDArray[np.float32],
    kept_farthest_w: NDArray[np.float32],
    window: NDArray[np.int64],
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    rectangles: NDArray[np.int32],
) -> None:
    """Draw the `chosen` (M,) of M meshes over what is kept of the `others`, into nearest and farthest inverse depth.

    Meshes, poses and `rectangles` as in `project.place_meshes`. Faces turned away are left out where a mesh is `closed`
    (M,) (Algorithm 3). The buffers of 1/m hold, where a rectangle reaches, `window` of the picture, which is laid anew;
    they have room for H * (W + LANES) + LANES pixels. `farthest_w` is of the farthest *drawn* surface.
    Scratch: `placed` (6, V), `before` (M,), `kinds` (most faces of a mesh,), `lists` (3, most faces + 1),
    `corners` (3, 3), `polygon` (4, 3).
    """
    place_meshes(
        vertices_m, offsets, faces, vertex_starts, face_starts, chosen, T_camera_mesh, padding_m, camera,
        width, height, placed, before, corners, polygon, rectangles,
    )  # fmt: skip
    open_window(rectangles, chosen, others, window, nearest_w, farthest_w)
    copy_window(
        rectangles, others, kept_window, kept_nearest_w, kept_farthest_w, window, nearest_w, farthest_w
    )  # fmt: skip
    for m in range(len(closed)):
        first, end = vertex_starts[m], vertex_starts[m + 1]
        if not chosen[m] or before[m] == end - first:
            continue
        a, b, c = faces[0], faces[1], faces[2]
        start, stop = face_starts[m], face_starts[m + 1]
        fill_mesh(
            a[start:stop], b[start:stop], c[start:stop], closed[m], before[m],
            placed[0, first:end], placed[1, first:end], placed[2, first:end],
            placed[3, first:end], placed[4, first:end], placed[5, first:end],
            camera, width, height, window, kinds[: stop - start], lists, corners, polygon, nearest_w, farthest_w,
        )  # fmt: skip
