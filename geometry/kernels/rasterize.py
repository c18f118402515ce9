# SPDX-License-Identifier: Apache-2.0
"""Rasterize meshes: a z-buffer of inverse depth (the paper's Algorithms 2 to 4).

On the screen 1/z is linear, not z. So the buffers hold `w = 1/z` (1/m): the nearest surface has the largest w, and 0
means that there is no surface. The farthest surface is stored as `-w`, so that the largest value wins in both buffers.
The nearest surface of a closed mesh consists of its front faces, and the farthest of its back faces: each triangle is
drawn into one buffer only.

A buffer holds only a *window* of the image, the rectangle around everything drawn. Thirty times a second it comes from
cold memory, where few contiguous pages are several times faster than many scattered ones.

Small triangles, which are nearly all, are drawn by edge functions in integers, which never round, `LANES` pixels of a
row at once. Large ones are drawn span by span in float64.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.int32 import add, multiply, none_negative
from geometry.kernels.jit import kernel
from geometry.kernels.project import SUBPIXELS, Mesh, Meshes, Scratch, Screen, clip, mesh_of, place_meshes, take_corners

NOTHING_NEAREST = np.float32(0.0)
"""`nearest_w` of a pixel without a surface: infinitely far."""

NOTHING_FARTHEST = np.float32(-1e6)
"""`farthest_w` of a pixel without a surface: a micrometre away, so that any surface is farther. It is not the smallest
float32, whose inverse is subnormal and costs a hundred cycles a pixel."""

LANES = 16
"""Pixels of a row drawn at once, needed or not; buffers are wider than the image by this. With fewer, the compiler
unrolls the loop before it can vectorise it."""

SMALL_ROWS = 96
"""Triangles up to twice `LANES` wide and this many rows high are drawn with integers of 32 bits. An edge function is
the difference of two products, at most (32 + 16) * 96 + 32 * 96 pixels in units of 1/512 squared: 2.01e9 of 2.15e9."""

UNSEEN, SMALL, LARGE = 0, 1, 2
"""Kinds of triangles: not drawn, since it faces away or contains no pixel centre; drawn by integers, if at most twice
`LANES` wide and `SMALL_ROWS` high; else drawn span by span."""

AWAY = 4
"""Added to the kind of a back face."""


class Buffer(NamedTuple):
    """Buffers to draw into, 1/m.

    `window` (4,): first row, first column, rows, and columns including those that `LANES` may overrun. `nearest_w` and
    `farthest_w` are flat, with room for H * (W + LANES) + LANES pixels. An empty `farthest_w` is not drawn.
    """

    window: NDArray[np.int64]
    nearest_w: NDArray[np.float32]
    farthest_w: NDArray[np.float32]


class Side(NamedTuple):
    """The nearest or the farthest surface: the faces that show it, front or back, and its buffer.

    The largest of `sign * w` wins; `sign` is 1 for the nearest.
    """

    with_here: bool
    with_away: bool
    sign: np.float32
    window: NDArray[np.int64]
    buffer_w: NDArray[np.float32]


class Corner(NamedTuple):
    """A corner of a triangle: pixel coordinates and w."""

    u: float
    v: float
    w: float


@kernel
def sort_faces(mesh: Mesh, with_away: bool, screen: Screen, kinds: NDArray[np.uint8]) -> None:
    """Classify each triangle of a mesh whose corners are all beyond the near plane.

    Written for the vectoriser: no branch. Back faces are left out unless required (Algorithm 3).
    """
    a, b, c, u_px, v_px = mesh.a, mesh.b, mesh.c, mesh.u_px, mesh.v_px
    last_column, last_row = np.float32(screen.width - 1), np.float32(screen.height - 1)
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
        # UNSEEN plus one for each condition; a choice between constants would not be vectorised.
        kinds[f] = np.uint8(seen) + np.uint8(seen & large) + np.uint8(AWAY) * np.uint8(seen & away)


@kernel
def sort_cut_faces(mesh: Mesh, near_m: np.float32, kinds: NDArray[np.uint8]) -> None:
    """Correct `kinds` of triangles with a corner before the near plane: such a triangle is cut, or not visible.

    Clipping determines the direction that it faces.
    """
    z_m = mesh.z_m
    for f in range(len(mesh.a)):
        beyond = 0
        beyond += z_m[mesh.a[f]] >= near_m
        beyond += z_m[mesh.b[f]] >= near_m
        beyond += z_m[mesh.c[f]] >= near_m
        if beyond < 3:
            kinds[f] = LARGE if beyond > 0 else UNSEEN


@kernel
def list_faces(
    kinds: NDArray[np.uint8], here: NDArray[np.int32], away: NDArray[np.int32], large: NDArray[np.int32]
) -> tuple[int, int, int]:
    """List the indices of the small front faces, the small back faces and the large triangles; return their numbers."""
    # Unsigned, since numba tests a signed index for counting from the end.
    heres, aways, larges = np.uint64(0), np.uint64(0), np.uint64(0)
    for f in range(len(kinds)):
        # Always written, and counted only if it belongs here: a branch would be mispredicted too often.
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
def fill_small(faces: NDArray[np.int32], mesh: Mesh, screen: Screen, side: Side) -> None:
    """Draw the small triangles with the indices `faces`.

    A pixel is drawn if its centre is inside all three edges or on one. Neighbours leave no gap, since integers do not
    round.
    """
    a, b, c = mesh.a, mesh.b, mesh.c
    u_px, v_px, w_per_m = mesh.u_px, mesh.v_px, mesh.w_per_m
    sign, buffer_w = side.sign, side.buffer_w
    zero = np.float32(0.0)
    last_column, last_row = np.float32(screen.width - 1), np.float32(screen.height - 1)
    pixel = np.int32(SUBPIXELS)
    first_row, first_column, stride = side.window[0], side.window[1], side.window[3]
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
        # From here on in subpixels relative to the first pixel.
        x0, y0 = np.int32((u0 - u_left) * SUBPIXELS), np.int32((v0 - v_top) * SUBPIXELS)
        x1, y1 = np.int32((u1 - u_left) * SUBPIXELS), np.int32((v1 - v_top) * SUBPIXELS)
        x2, y2 = np.int32((u2 - u_left) * SUBPIXELS), np.int32((v2 - v_top) * SUBPIXELS)
        double_area = np.int32((x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0))
        turn = np.int32(1) if double_area > 0 else np.int32(-1)
        # Each edge function, positive inside: its change by a subpixel to the right and down, and its start.
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
        # The gradient of a sliver is ill-conditioned: never leave the range of its corners.
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
def fill_triangle(one: Corner, two: Corner, three: Corner, screen: Screen, side: Side) -> None:
    """Draw one triangle of any size; the largest w wins.

    Every pixel centre on or inside an edge is drawn. The crossing of an edge with a row is computed from the edge's
    upper end for both triangles that share it, so neighbours leave no gap.
    """
    u0, v0, w0 = one
    u1, v1, w1 = two
    u2, v2, w2 = three
    left = max(math.ceil(min(u0, u1, u2)), 0)
    right = min(math.floor(max(u0, u1, u2)), screen.width - 1)
    top = max(math.ceil(min(v0, v1, v2)), 0)
    bottom = min(math.floor(max(v0, v1, v2)), screen.height - 1)
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
        # The gradient of a sliver is ill-conditioned: never leave the range of its corners.
        w_row = w0 + (y - v0) * w_per_v
        w = min(max(np.float32(w_row + (first - u0) * w_per_u), w_low), w_high)
        w_last = min(max(np.float32(w_row + (last - u0) * w_per_u), w_low), w_high)
        step = (w_last - w) / np.float32(max(last - first, 1))
        at = (y - side.window[0]) * side.window[3] + first - side.window[1]
        buffer_row = side.buffer_w[at : at + last + 1 - first]
        for x in range(len(buffer_row)):
            here = w + np.float32(x) * step
            buffer_row[x] = here if here > buffer_row[x] else buffer_row[x]


@kernel
def fill_clipped(screen: Screen, side: Side, scratch: Scratch) -> None:
    """Draw the part beyond the near plane of the triangle whose corners are in `scratch`."""
    sign, polygon = side.sign, scratch.polygon
    for i in range(1, clip(screen, scratch) - 1):
        u0, v0 = polygon[0, 0], polygon[0, 1]
        u1, v1 = polygon[i, 0], polygon[i, 1]
        u2, v2 = polygon[i + 1, 0], polygon[i + 1, 1]
        double_area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
        if (side.with_here and double_area < 0.0) or (side.with_away and double_area > 0.0):
            one, two = Corner(u0, v0, sign * polygon[0, 2]), Corner(u1, v1, sign * polygon[i, 2])
            fill_triangle(one, two, Corner(u2, v2, sign * polygon[i + 1, 2]), screen, side)


@kernel
def corner_of(mesh: Mesh, i: int, sign: np.float32) -> Corner:
    """Return vertex i in float64 as after clipping, so that neighbours agree where their edge crosses a row."""
    return Corner(np.float64(mesh.u_px[i]), np.float64(mesh.v_px[i]), np.float64(sign * mesh.w_per_m[i]))


@kernel
def fill_large(
    faces: NDArray[np.int32], mesh: Mesh, is_cut: bool, screen: Screen, side: Side, scratch: Scratch
) -> None:
    """Draw those large triangles with the indices `faces` that face the required direction.

    `is_cut` is True if vertices of their mesh are before the near plane.
    """
    near_m, z_m, sign = screen.near_m, mesh.z_m, side.sign
    for n in range(len(faces)):
        f = faces[n]
        i, j, k = mesh.a[f], mesh.b[f], mesh.c[f]
        if is_cut and (z_m[i] < near_m or z_m[j] < near_m or z_m[k] < near_m):
            take_corners(mesh, f, scratch.corners)
            fill_clipped(screen, side, scratch)
        elif side.with_away if scratch.kinds[f] >= AWAY else side.with_here:
            one, two, three = corner_of(mesh, i, sign), corner_of(mesh, j, sign), corner_of(mesh, k, sign)
            fill_triangle(one, two, three, screen, side)


@kernel
def fill_mesh(mesh: Mesh, closed: bool, is_cut: bool, screen: Screen, buffer: Buffer, scratch: Scratch) -> None:
    """Draw one of the meshes of `draw_meshes`; `is_cut` is True if some of its vertices are before the near plane."""
    with_farthest = len(buffer.farthest_w) > 0
    kinds, lists = scratch.kinds[: len(mesh.a)], scratch.lists
    sort_faces(mesh, not closed or with_farthest, screen, kinds)
    if is_cut:
        sort_cut_faces(mesh, screen.near_m, kinds)
    heres, aways, larges = list_faces(kinds, lists[0], lists[1], lists[2])
    here, away, large = lists[0, :heres], lists[1, :aways], lists[2, :larges]
    for n in range(1 + with_farthest):
        is_farthest = n == 1
        side = Side(
            not closed or not is_farthest,
            not closed or is_farthest,
            np.float32(-1.0) if is_farthest else np.float32(1.0),
            buffer.window,
            buffer.farthest_w if is_farthest else buffer.nearest_w,
        )
        if side.with_here:
            fill_small(here, mesh, screen, side)
        if side.with_away:
            fill_small(away, mesh, screen, side)
        fill_large(large, mesh, is_cut, screen, side, scratch)


@kernel
def span_of_row(
    y: int, rectangles: NDArray[np.int32], chosen: NDArray[np.bool_], others: NDArray[np.bool_]
) -> tuple[int, int]:
    """Return the columns of row y covered by `rectangles` (M, 4) of the `chosen` and the `others` (M,).

    The result is the first column and the one after the last, or (0, 0) for none.
    """
    first, end = 0, 0
    for m in range(len(rectangles)):
        if (chosen[m] or others[m]) and rectangles[m, 0] <= y <= rectangles[m, 1]:
            first = min(first, rectangles[m, 2]) if end > 0 else rectangles[m, 2]
            end = max(end, rectangles[m, 3] + 1)
    return first, end


@kernel
def open_window(
    rectangles: NDArray[np.int32], chosen: NDArray[np.bool_], others: NDArray[np.bool_], buffer: Buffer
) -> None:
    """Set the window around the `rectangles` (M, 4) of the `chosen` and the `others` (M,), and clear their pixels."""
    window, nearest_w, farthest_w = buffer
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
def copy_window(rectangles: NDArray[np.int32], chosen: NDArray[np.bool_], kept: Buffer, buffer: Buffer) -> None:
    """Copy the pixels of the `chosen` (M,) `rectangles` (M, 4) into a `buffer` whose window encloses the source's."""
    window = buffer.window
    for y in range(kept.window[0], kept.window[0] + kept.window[2]):
        first, end = span_of_row(y, rectangles, chosen, chosen)
        source = (y - kept.window[0]) * kept.window[3] - kept.window[1]
        at = (y - window[0]) * window[3] - window[1]
        buffer.nearest_w[at + first : at + end] = kept.nearest_w[source + first : source + end]
        if len(buffer.farthest_w) > 0:
            buffer.farthest_w[at + first : at + end] = kept.farthest_w[source + first : source + end]


@kernel
def draw_meshes(
    meshes: Meshes,
    chosen: NDArray[np.bool_],
    others: NDArray[np.bool_],
    T_camera_mesh: NDArray[np.float64],
    padding_m: NDArray[np.float32],
    screen: Screen,
    kept: Buffer,
    buffer: Buffer,
    rectangles: NDArray[np.int32],
    scratch: Scratch,
) -> None:
    """Draw the `chosen` (M,) of M meshes over the `kept` drawing of the `others`: nearest and farthest 1/z.

    Poses (M, 4, 4), padding and `rectangles` as in `project.place_meshes`. Of a closed mesh, only front faces are drawn
    into `nearest_w` (Algorithm 3), and only back faces into `farthest_w`. The window of `buffer` is set anew to cover
    all rectangles. If the near plane cuts away the front of a closed mesh, a pixel may have a farthest surface without
    a nearest.
    """
    meshes, screen, scratch = Meshes(*meshes), Screen(*screen), Scratch(*scratch)
    kept, buffer = Buffer(*kept), Buffer(*buffer)
    place_meshes(meshes, chosen, T_camera_mesh, padding_m, screen, scratch, rectangles)
    open_window(rectangles, chosen, others, buffer)
    copy_window(rectangles, others, kept, buffer)
    for m in range(len(chosen)):
        before = scratch.before[m]
        if not chosen[m] or before == meshes.vertex_starts[m + 1] - meshes.vertex_starts[m]:
            continue
        fill_mesh(mesh_of(m, meshes, scratch), meshes.closed[m], before > 0, screen, buffer, scratch)
