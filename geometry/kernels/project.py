# SPDX-License-Identifier: Apache-2.0
"""Projection of meshes onto the screen.

Conventions are those of `pinhole`. Corners are rounded to `1 / SUBPIXELS` of a pixel, so that the rasterizer computes
with them without rounding.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import moved, project, rows_of_32

SUBPIXELS = np.float32(512.0)
"""Rounding of corners: at most a thousandth of a pixel, while a depth camera cannot resolve half a pixel."""

SUBPIXEL = np.float32(1.0 / 512.0)


class Screen(NamedTuple):
    """The camera to render for, in float32: `fx`, `fy`, `cx`, `cy`, `width` and `height` in pixels."""

    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    near_m: np.float32
    width: int
    height: int


class Meshes(NamedTuple):
    """M meshes in flat arrays.

    Mesh m has the vertices `vertex_starts[m]:vertex_starts[m + 1]` (M + 1,) of `vertices_m` (3, V), and likewise faces
    of `faces` (3, F), whose indices count from the mesh's own first vertex. A vertex is placed at
    `vertex + padding_m * offset`, with `offsets` (3, V). The back of a `closed` (M,) mesh is never seen.
    """

    vertices_m: NDArray[np.float32]
    offsets: NDArray[np.float32]
    faces: NDArray[np.int32]
    vertex_starts: NDArray[np.int32]
    face_starts: NDArray[np.int32]
    closed: NDArray[np.bool_]


class Scratch(NamedTuple):
    """Memory for drawing meshes.

    `placed` (6, V): pixel coordinates, inverse depth, and, for a mesh cut by the near plane, coordinates in the camera
    frame. `before` (M,): number of each mesh's vertices before the near plane. `kinds` (most faces of a mesh,) and
    `lists` (3, most faces + 1) of its triangles. `corners` (3, 3) and `polygon` (4, 3) of a triangle that is cut.
    """

    placed: NDArray[np.float32]
    before: NDArray[np.int32]
    kinds: NDArray[np.uint8]
    lists: NDArray[np.int32]
    corners: NDArray[np.float32]
    polygon: NDArray[np.float64]


class Vertices(NamedTuple):
    """Positions or offsets of a mesh's vertices, one array for each coordinate."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]


class Mesh(NamedTuple):
    """A placed mesh: the corner indices of its triangles, and its vertices (see `Scratch.placed`)."""

    a: NDArray[np.int32]
    b: NDArray[np.int32]
    c: NDArray[np.int32]
    u_px: NDArray[np.float32]
    v_px: NDArray[np.float32]
    w_per_m: NDArray[np.float32]
    x_m: NDArray[np.float32]
    y_m: NDArray[np.float32]
    z_m: NDArray[np.float32]


@kernel
def rounded(u_or_v: np.float32) -> np.float32:
    """Round a pixel coordinate to whole subpixels."""
    return np.float32(np.rint(u_or_v * SUBPIXELS) * SUBPIXEL)


@kernel
def mesh_of(m: int, meshes: Meshes, scratch: Scratch) -> Mesh:
    """Return mesh m with its placed vertices."""
    a, b, c = meshes.faces[0], meshes.faces[1], meshes.faces[2]
    start, stop = meshes.face_starts[m], meshes.face_starts[m + 1]
    first, end = meshes.vertex_starts[m], meshes.vertex_starts[m + 1]
    placed = scratch.placed
    return Mesh(
        a[start:stop], b[start:stop], c[start:stop],
        placed[0, first:end], placed[1, first:end], placed[2, first:end],
        placed[3, first:end], placed[4, first:end], placed[5, first:end],
    )  # fmt: skip


@kernel
def place_vertices(
    vertices_m: Vertices,
    offsets: Vertices,
    padding_m: np.float32,
    T_camera_mesh: NDArray[np.float64],
    screen: Screen,
    mesh: Mesh,
) -> int:
    """Project vertices into `mesh`; return the number of vertices before the near plane.

    Written for the vectoriser: one type, no branch, one array for each coordinate.
    """
    rows = rows_of_32(T_camera_mesh)
    x_m, y_m, z_m = vertices_m
    offset_x, offset_y, offset_z = offsets
    u_px, v_px, w_per_m = mesh.u_px, mesh.v_px, mesh.w_per_m
    near_m = screen.near_m
    one = np.float32(1.0)
    before = 0
    for i in range(len(x_m)):
        px = x_m[i] + padding_m * offset_x[i]
        py = y_m[i] + padding_m * offset_y[i]
        pz = z_m[i] + padding_m * offset_z[i]
        x, y, z = moved(rows, px, py, pz)
        w = one / max(z, near_m)
        u, v = project(x, y, w, screen)
        u_px[i], v_px[i], w_per_m[i] = rounded(u), rounded(v), w
        before += z < near_m
    return before


@kernel
def bring_vertices(
    vertices_m: Vertices, offsets: Vertices, padding_m: np.float32, T_camera_mesh: NDArray[np.float64], mesh: Mesh
) -> None:
    """Transform vertices into the camera frame, by the same arithmetic as `place_vertices`; only cut meshes need it."""
    rows = rows_of_32(T_camera_mesh)
    x_m, y_m, z_m = vertices_m
    offset_x, offset_y, offset_z = offsets
    camera_x_m, camera_y_m, camera_z_m = mesh.x_m, mesh.y_m, mesh.z_m
    for i in range(len(x_m)):
        px = x_m[i] + padding_m * offset_x[i]
        py = y_m[i] + padding_m * offset_y[i]
        pz = z_m[i] + padding_m * offset_z[i]
        camera_x_m[i], camera_y_m[i], camera_z_m[i] = moved(rows, px, py, pz)


@kernel
def bound(mesh: Mesh, screen: Screen, rectangle: NDArray[np.int32]) -> None:
    """Set `rectangle` (4,) to the pixels within a mesh's bounds; in integers, which can be vectorised."""
    u_px, v_px, width, height = mesh.u_px, mesh.v_px, screen.width, screen.height
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
def clip(screen: Screen, scratch: Scratch) -> int:
    """Clip the triangle whose corners are in `scratch` at the near plane; return the number of corners left.

    Out: its `polygon`, pixel coordinates and inverse depth; a triangle cut by a plane has up to four corners.
    """
    corners, polygon, near_m = scratch.corners, scratch.polygon, screen.near_m
    count = 0
    for i in range(3):
        j = (i + 1) % 3
        z_i = corners[i, 2]
        z_j = corners[j, 2]
        if z_i >= near_m:
            # Computed as in `place_vertices`: a neighbour that is not cut has the same corners.
            w = np.float32(1.0) / z_i
            u, v = project(corners[i, 0], corners[i, 1], w, screen)
            polygon[count, 0], polygon[count, 1], polygon[count, 2] = rounded(u), rounded(v), w
            count += 1
        if (z_i >= near_m) != (z_j >= near_m):
            # Always from the end in front, so that a neighbour that is cut too computes the same point.
            front, back = (i, j) if z_i >= near_m else (j, i)
            share = (near_m - corners[front, 2]) / (corners[back, 2] - corners[front, 2])
            x = corners[front, 0] + share * (corners[back, 0] - corners[front, 0])
            y = corners[front, 1] + share * (corners[back, 1] - corners[front, 1])
            w = np.float32(1.0) / near_m
            polygon[count, 0], polygon[count, 1] = project(x, y, w, screen)
            polygon[count, 2] = w
            count += 1
    return count


@kernel
def take_corners(mesh: Mesh, f: int, corners: NDArray[np.float32]) -> None:
    """Copy the corners (3, 3) of triangle f in the camera frame."""
    i, j, k = mesh.a[f], mesh.b[f], mesh.c[f]
    corners[0, 0], corners[0, 1], corners[0, 2] = mesh.x_m[i], mesh.y_m[i], mesh.z_m[i]
    corners[1, 0], corners[1, 1], corners[1, 2] = mesh.x_m[j], mesh.y_m[j], mesh.z_m[j]
    corners[2, 0], corners[2, 1], corners[2, 2] = mesh.x_m[k], mesh.y_m[k], mesh.z_m[k]


@kernel
def bound_cut(mesh: Mesh, screen: Screen, scratch: Scratch, rectangle: NDArray[np.int32]) -> None:
    """Do the same as `bound` for a mesh cut by the near plane: bound the clipped triangles."""
    width, height, polygon = screen.width, screen.height, scratch.polygon
    left, top, right, bottom = 1e9, 1e9, -1.0, -1.0
    for f in range(len(mesh.a)):
        take_corners(mesh, f, scratch.corners)
        for n in range(clip(screen, scratch)):
            left, right = min(left, polygon[n, 0]), max(right, polygon[n, 0])
            top, bottom = min(top, polygon[n, 1]), max(bottom, polygon[n, 1])
    rectangle[0], rectangle[1] = math.ceil(max(top, 0.0)), math.floor(min(bottom, height - 1.0))
    rectangle[2], rectangle[3] = math.ceil(max(left, 0.0)), math.floor(min(right, width - 1.0))
    if rectangle[0] > rectangle[1] or rectangle[2] > rectangle[3]:
        rectangle[0], rectangle[1], rectangle[2], rectangle[3] = height, -1, width, -1


@kernel
def place_meshes(
    meshes: Meshes,
    chosen: NDArray[np.bool_],
    T_camera_mesh: NDArray[np.float64],
    padding_m: NDArray[np.float32],
    screen: Screen,
    scratch: Scratch,
    rectangles: NDArray[np.int32],
) -> None:
    """Project the `chosen` (M,) of M meshes onto the screen, each with its pose (M, 4, 4) and padding (M,).

    Out: the placed vertices in `scratch`; `rectangles` (M, 4), the pixels that a mesh may touch: first and last row,
    first and last column, empty (first > last) if it is not in view.
    """
    x_m, y_m, z_m = meshes.vertices_m[0], meshes.vertices_m[1], meshes.vertices_m[2]
    offset_x, offset_y, offset_z = meshes.offsets[0], meshes.offsets[1], meshes.offsets[2]
    for m in range(len(chosen)):
        if not chosen[m]:
            continue
        first, end = meshes.vertex_starts[m], meshes.vertex_starts[m + 1]
        vertices_m = Vertices(x_m[first:end], y_m[first:end], z_m[first:end])
        offsets = Vertices(offset_x[first:end], offset_y[first:end], offset_z[first:end])
        # With a padding of 0 the offsets do not matter: use any array that is already in the cache.
        added = offsets if padding_m[m] != 0.0 else vertices_m
        mesh = mesh_of(m, meshes, scratch)
        scratch.before[m] = place_vertices(vertices_m, added, padding_m[m], T_camera_mesh[m], screen, mesh)
        if scratch.before[m] == 0:
            bound(mesh, screen, rectangles[m])
        else:
            bring_vertices(vertices_m, added, padding_m[m], T_camera_mesh[m], mesh)
            bound_cut(mesh, screen, scratch, rectangles[m])
