# SPDX-License-Identifier: Apache-2.0
"""The surface at a distance from a mesh, computed on a grid of distances."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel

EDGES = np.array(
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]], dtype=np.int64
)
"""Edges of a grid cell; corner c lies at (c >> 2, c >> 1 & 1, c & 1)."""


@kernel
def sample_faces(
    vertices_m: NDArray[np.float32],
    faces: NDArray[np.int32],
    spacing_m: float,
    first: int,
    samples_m: NDArray[np.float32],
) -> int:
    """Sample triangles with points at most `spacing_m` apart; return the number of all points.

    Write the points from number `first` on to `samples_m` (S, 3), as many as fit. Call with S = 0 for the number only.
    """
    number = -first
    for f in range(len(faces)):
        a, b, c = vertices_m[faces[f, 0]], vertices_m[faces[f, 1]], vertices_m[faces[f, 2]]
        longest = 0.0
        for k in range(3):
            p, q = vertices_m[faces[f, k]], vertices_m[faces[f, (k + 1) % 3]]
            longest = max(longest, (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
        steps = max(math.ceil(math.sqrt(longest) / spacing_m), 1)
        points = (steps + 1) * (steps + 2) // 2
        if number >= len(samples_m) or number + points <= 0:
            number += points
            continue
        for i in range(steps + 1):
            for j in range(steps + 1 - i):
                if 0 <= number < len(samples_m):
                    s, t = i / steps, j / steps
                    for k in range(3):
                        samples_m[number, k] = a[k] + s * (b[k] - a[k]) + t * (c[k] - a[k])
                number += 1
    return number + first


@kernel
def spread_distance(
    samples_m: NDArray[np.float32],
    origin_m: NDArray[np.float32],
    spacing_m: np.float32,
    reach: int,
    squared_m2: NDArray[np.float32],
) -> None:
    """Lower each grid node's squared distance (nx, ny, nz) to that of the nearest sample within `reach` nodes.

    Node (i, j, k) is at `origin_m + spacing_m * (i, j, k)`. Nodes beyond the reach of all samples keep their value.
    """
    nx, ny, nz = squared_m2.shape
    for s in range(len(samples_m)):
        gx = (samples_m[s, 0] - origin_m[0]) / spacing_m
        gy = (samples_m[s, 1] - origin_m[1]) / spacing_m
        gz = (samples_m[s, 2] - origin_m[2]) / spacing_m
        low_z, high_z = max(int(gz) - reach, 0), min(int(gz) + reach + 1, nz - 1)
        for i in range(max(int(gx) - reach, 0), min(int(gx) + reach + 1, nx - 1) + 1):
            for j in range(max(int(gy) - reach, 0), min(int(gy) + reach + 1, ny - 1) + 1):
                dx, dy = np.float32(i) - gx, np.float32(j) - gy
                across = dx * dx + dy * dy
                row = squared_m2[i, j, low_z : high_z + 1]
                for k in range(len(row)):
                    dz = np.float32(low_z + k) - gz
                    row[k] = min(row[k], (across + dz * dz) * spacing_m * spacing_m)


@kernel
def flood_outside(inside: NDArray[np.bool_], outside: NDArray[np.bool_], stack: NDArray[np.int64]) -> None:
    """Mark in `outside` (nx, ny, nz) the nodes connected with node (0, 0, 0) without passing through `inside`.

    `stack` (nx*ny*nz,) is scratch.
    """
    nx, ny, nz = inside.shape
    outside[:] = False
    outside[0, 0, 0] = True
    stack[0] = 0
    height = 1
    while height > 0:
        height -= 1
        node = stack[height]
        k, j, i = node % nz, node // nz % ny, node // (nz * ny)
        for step in range(6):
            axis, sign = step // 2, 1 - 2 * (step % 2)
            x, y, z = i + sign * (axis == 0), j + sign * (axis == 1), k + sign * (axis == 2)
            if x < 0 or y < 0 or z < 0 or x >= nx or y >= ny or z >= nz:
                continue
            if not outside[x, y, z] and not inside[x, y, z]:
                outside[x, y, z] = True
                stack[height] = (x * ny + y) * nz + z
                height += 1


@kernel
def surface_net(
    field: NDArray[np.float32],
    vertex_of_cell: NDArray[np.int32],
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
) -> tuple[int, int]:
    """Compute the zero surface of `field` (nx, ny, nz), negative inside (naive surface nets, Gibson 1998).

    Each cell has one vertex. Write vertices (V, 3), in nodes, and faces (F, 3), which face outwards, as many as fit the
    arrays; return V and F. `vertex_of_cell` (nx, ny, nz) is scratch. The outermost nodes must be positive.
    """
    nx, ny, nz = field.shape
    vertex_of_cell[:] = -1
    vertex_number = 0
    for i in range(nx - 1):
        for j in range(ny - 1):
            for k in range(nz - 1):
                crossings = 0
                x, y, z = 0.0, 0.0, 0.0
                for e in range(len(EDGES)):
                    p, q = EDGES[e, 0], EDGES[e, 1]
                    px, py, pz = i + (p >> 2), j + ((p >> 1) & 1), k + (p & 1)
                    qx, qy, qz = i + (q >> 2), j + ((q >> 1) & 1), k + (q & 1)
                    a, b = field[px, py, pz], field[qx, qy, qz]
                    if (a < 0.0) != (b < 0.0):
                        share = a / (a - b)
                        x += px + share * (qx - px)
                        y += py + share * (qy - py)
                        z += pz + share * (qz - pz)
                        crossings += 1
                if crossings > 0:
                    if vertex_number < len(vertices):
                        vertices[vertex_number, 0] = x / crossings
                        vertices[vertex_number, 1] = y / crossings
                        vertices[vertex_number, 2] = z / crossings
                    vertex_of_cell[i, j, k] = vertex_number
                    vertex_number += 1
    face_number = 0
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                here = field[i, j, k] < 0.0
                for axis in range(3):
                    # Four cells share the edge from this node along the axis; b and c are the other two axes.
                    there = field[i + (axis == 0), j + (axis == 1), k + (axis == 2)] < 0.0
                    if here == there:
                        continue
                    if face_number + 2 <= len(faces):
                        bx, by, bz = axis == 2, axis == 0, axis == 1
                        cx, cy, cz = axis == 1, axis == 2, axis == 0
                        v0 = vertex_of_cell[i - bx - cx, j - by - cy, k - bz - cz]
                        v1 = vertex_of_cell[i - cx, j - cy, k - cz]
                        v2 = vertex_of_cell[i, j, k]
                        v3 = vertex_of_cell[i - bx, j - by, k - bz]
                        if not here:
                            v1, v3 = v3, v1
                        faces[face_number, 0] = v0
                        faces[face_number, 1] = v1
                        faces[face_number, 2] = v2
                        faces[face_number + 1, 0] = v0
                        faces[face_number + 1, 1] = v2
                        faces[face_number + 1, 2] = v3
                    face_number += 2
    return vertex_number, face_number
