# SPDX-License-Identifier: Apache-2.0
"""Meshes onto the screen: a z-buffer of inverse depth (the paper's Algorithms 2 to 4).

What is linear on the screen is 1/z, not z; so the buffers hold `w = 1/z` (1/m): the nearest surface has the largest w,
and 0 means that nothing stands there. The farthest surface is kept as `-w`, so that of either the largest counts.
A closed mesh shows its nearest surface by the faces that are turned here, and its farthest by those turned away: each
of its triangles is drawn into one buffer only.

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

from geometry.kernels.int32 import add, multiply, none_negative
from geometry.kernels.jit import kernel
from geometry.kernels.project import SUBPIXELS, clip, corners_of, place_meshes

NOTHING_NEAREST = np.float32(0.0)
"""`nearest_w` of a pixel without a surface: infinitely far."""

NOTHING_FARTHEST = np.float32(-1e6)
"""`farthest_w` of a pixel without a surface: a micrometre away, so that any surface is farther. Not the least
float32: its inverse is subnormal, which costs a hundred cycles a pixel."""

LANES = 16
"""Pixels of a row that are drawn at once, whether they are needed or not; buffers are so much wider than the picture.
With fewer the compiler unrolls the loop before it could vectorise it."""

SMALL_ROWS = 96
"""Triangles up to twice `LANES` wide and so many rows high are drawn with integers of 32 bits. An edge's function is
the difference of two products, at most (32 + 16) * 96 + 32 * 96 pixels in units of 1/512 squared: 2.01e9 of 2.15e9."""

UNSEEN, SMALL, LARGE = 0, 1, 2
"""What is done with a triangle: nothing, for it is not wanted or holds no pixel centre; or how it is drawn: by integers
when no wider than twice `LANES` and no higher than `SMALL_ROWS`, else span by span."""

AWAY = 4
"""Added to it when the triangle is turned away."""


@kernel
def sort_faces(
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    u_px: NDArray[np.float32],
    v_px: NDArray[np.float32],
    with_away: bool,
    last_column: np.float32,
    last_row: np.float32,
    kinds: NDArray[np.uint8],
) -> None:
    """What is to be done with each triangle, all of whose corners lie beyond the near plane.

    Written for the vectoriser: no branch. Faces turned away are left out unless they are wanted (Algorithm 3).
    """
    zero, width, height = np.float32(0.0), np.float32(2 * LANES - 1), np.float32(SMALL_ROWS - 1)
    for f in range(len(a)):
        i, j, k = np.uint32(a[f]), np.uint32(b[f]), np.uint32(c[f])
        u0, u1, u2 = u_px[i], u_px[j], u_px[k]
        v0, v1, v2 = v_px[i], v_px[j], v_px[k]
        left, right = min(u0, min(u1, u2)), max(u0, max(u1, u2))
        top, bottom = min(v0, min(v1, v2)), max(v0, max(v1, v2))
        holds_column = np.ceil(max(left, zero)) <= np.floor(min(right, last_column))
        holds_row = np.ceil(max(top, zero)) <= np.floor(min(bottom, last_row))
        double_area = np.float64(u1 - u0) * np.float64(v2 - v0) - np.float64(u2 - u0) * np.float64(v1 - v0)
        away = with_away & (double_area > 0.0)
        seen = holds_column & holds_row & ((double_area < 0.0) | away)
        large = (bottom - top > height) | (right - left > width)
        # UNSEEN and one more for each step; a choice between constants would not be vectorised.
        kinds[f] = np.uint8(seen) + np.uint8(seen & large) + np.uint8(AWAY) * np.uint8(seen & away)


@kernel
def sort_cut_faces(
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    camera_z_m: NDArray[np.float32],
    near_m: np.float32,
    kinds: NDArray[np.uint8],
) -> None:
    """Mend `kinds` where a corner lies before the near plane: such a triangle is cut, or not seen at all.

    Where it is turned is told when it is cut.
    """
    for f in range(len(a)):
        beyond = 0
        beyond += camera_z_m[a[f]] >= near_m
        beyond += camera_z_m[b[f]] >= near_m
        beyond += camera_z_m[c[f]] >= near_m
        if beyond < 3:
            kinds[f] = LARGE if beyond > 0 else UNSEEN


@kernel
def list_faces(
    kinds: NDArray[np.uint8], here: NDArray[np.int32], away: NDArray[np.int32], large: NDArray[np.int32]
) -> tuple[int, int, int]:
    """The numbers of the small triangles turned here, of those turned away, and of the large; how many of each."""
    # Unsigned, for a signed index is tested for counting from the end.
    heres, aways, larges = np.uint64(0), np.uint64(0), np.uint64(0)
    for f in range(len(kinds)):
        # Written always and kept when it is one: a branch would be guessed wrong too often.
        here[heres] = f
        away[aways] = f
        large[larges] = f
        kind = kinds[f]
        heres += np.uint64(kind == SMALL)
        aways += np.uint64(kind == SMALL + AWAY)
        larges += np.uint64((kind == LARGE) | (kind == LARGE + AWAY))
    # To numba they are plain numbers.
    return np.int64(heres), np.int64(aways), np.int64(larges)  # type: ignore[return-value]  # plain numbers to numba


@kernel
def fill_small(
    faces: NDArray[np.int32],
    sign: np.float32,
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    u_px: NDArray[np.float32],
    v_px: NDArray[np.float32],
    w_per_m: NDArray[np.float32],
    width: int,
    height: int,
    window: NDArray[np.int64],
    buffer_w: NDArray[np.float32],
) -> None:
    """Draw the small triangles whose numbers are `faces`: the largest of `sign * w`, which is 1 for the nearest.

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
        w0, w1, w2 = sign * w_per_m[i], sign * w_per_m[j], sign * w_per_m[k]
        u_left = np.ceil(max(min(u0, min(u1, u2)), zero))
        v_top = np.ceil(max(min(v0, min(v1, v2)), zero))
        left, top = np.int32(u_left), np.int32(v_top)
        right = np.int32(min(max(u0, max(u1, u2)), last_column))
        bottom = np.int32(min(max(v0, max(v1, v2)), last_row))
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
        for part in range(0, right - left + 1, LANES):
            shift = np.int32(part)
            here_0 = np.int32(edge_0 + shift * per_x_0)
            here_1 = np.int32(edge_1 + shift * per_x_1)
            here_2 = np.int32(edge_2 + shift * per_x_2)
            here_w = w + np.float32(shift) * w_per_u
            row = at + np.uint64(part)
            for _ in range(bottom - top + 1):
                for lane in range(LANES):
                    x = np.int32(lane)
                    inside = none_negative(
                        add(here_0, multiply(x, per_x_0)),
                        add(here_1, multiply(x, per_x_1)),
                        add(here_2, multiply(x, per_x_2)),
                    )
                    here = min(max(here_w + np.float32(x) * w_per_u, w_low), w_high)
                    before = buffer_w[row + np.uint64(lane)]
                    buffer_w[row + np.uint64(lane)] = here if inside & (here > before) else before
                here_0, here_1, here_2 = add(here_0, per_y_0), add(here_1, per_y_1), add(here_2, per_y_2)
                here_w += w_per_v
                row += np.uint64(stride)


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
    buffer_w: NDArray[np.float32],
) -> None:
    """Draw one triangle of any size, given by pixel coordinates and w of its corners: the largest w.

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
        buffer_row = buffer_w[at : at + last + 1 - first]
        for x in range(len(buffer_row)):
            here = w + np.float32(x) * step
            buffer_row[x] = here if here > buffer_row[x] else buffer_row[x]


@kernel
def fill_clipped(
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    with_here: bool,
    with_away: bool,
    sign: np.float32,
    camera: NDArray[np.float32],
    width: int,
    height: int,
    window: NDArray[np.int64],
    buffer_w: NDArray[np.float32],
) -> None:
    """Draw what lies beyond the near plane of a triangle with corners (3, 3) in the camera frame; `polygon` (4, 3)."""
    for i in range(1, clip(corners, camera, polygon) - 1):
        u0, v0 = polygon[0, 0], polygon[0, 1]
        u1, v1 = polygon[i, 0], polygon[i, 1]
        u2, v2 = polygon[i + 1, 0], polygon[i + 1, 1]
        double_area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
        if (with_here and double_area < 0.0) or (with_away and double_area > 0.0):
            fill_triangle(
                u0, v0, sign * polygon[0, 2],
                u1, v1, sign * polygon[i, 2],
                u2, v2, sign * polygon[i + 1, 2],
                width, height, window, buffer_w,
            )  # fmt: skip


@kernel
def fill_large(
    faces: NDArray[np.int32],
    kinds: NDArray[np.uint8],
    with_here: bool,
    with_away: bool,
    sign: np.float32,
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
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
    corners: NDArray[np.float32],
    polygon: NDArray[np.float64],
    buffer_w: NDArray[np.float32],
) -> None:
    """Draw those of the large triangles whose numbers are `faces` that are turned as wanted, `sign` as in `fill_small`.

    They belong to a mesh `before` of whose vertices lie before the near plane.
    """
    near_m = camera[4]
    for n in range(len(faces)):
        f = faces[n]
        i, j, k = a[f], b[f], c[f]
        if before > 0 and (z_m[i] < near_m or z_m[j] < near_m or z_m[k] < near_m):
            corners_of(i, j, k, x_m, y_m, z_m, corners)
            fill_clipped(
                corners, polygon, with_here, with_away, sign, camera, width, height, window, buffer_w
            )  # fmt: skip
        elif with_away if kinds[f] >= AWAY else with_here:
            # In float64 as after clipping, so that neighbours agree on where their edge crosses a row.
            fill_triangle(
                np.float64(u_px[i]), np.float64(v_px[i]), np.float64(sign * w_per_m[i]),
                np.float64(u_px[j]), np.float64(v_px[j]), np.float64(sign * w_per_m[j]),
                np.float64(u_px[k]), np.float64(v_px[k]), np.float64(sign * w_per_m[k]),
                width, height, window, buffer_w,
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
    with_away = not closed or len(farthest_w) > 0
    sort_faces(a, b, c, u_px, v_px, with_away, np.float32(width - 1), np.float32(height - 1), kinds)
    if before > 0:
        sort_cut_faces(a, b, c, z_m, camera[4], kinds)
    heres, aways, larges = list_faces(kinds, lists[0], lists[1], lists[2])
    here, away, large = lists[0, :heres], lists[1, :aways], lists[2, :larges]
    for side in range(2):
        buffer_w = nearest_w if side == 0 else farthest_w
        if len(buffer_w) == 0:
            continue
        sign = np.float32(1.0) if side == 0 else np.float32(-1.0)
        with_here, with_away = not closed or side == 0, not closed or side == 1
        if with_here:
            fill_small(here, sign, a, b, c, u_px, v_px, w_per_m, width, height, window, buffer_w)
        if with_away:
            fill_small(away, sign, a, b, c, u_px, v_px, w_per_m, width, height, window, buffer_w)
        fill_large(
            large, kinds, with_here, with_away, sign, a, b, c, before, u_px, v_px, w_per_m, x_m, y_m, z_m,
            camera, width, height, window, corners, polygon, buffer_w,
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
        if len(farthest_w) > 0:
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
        if len(farthest_w) > 0:
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

    Meshes, poses and `rectangles` as in `project.place_meshes`. Where a mesh is `closed` (M,), only faces turned here
    (Algorithm 3) are drawn into `nearest_w`, and only those turned away into `farthest_w`. The buffers of 1/m hold,
    where a rectangle reaches, `window` of the picture, which is laid anew; they have room for H * (W + LANES) + LANES
    pixels. Where the near plane cuts away the front of a closed mesh, there may be a farthest surface without a
    nearest. `farthest_w`, kept and new, may be empty: then none is drawn.
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
