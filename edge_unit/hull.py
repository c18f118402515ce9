# SPDX-License-Identifier: Apache-2.0
"""A link as the solid that reaches a few centimetres around it: what is drawn of the padded robot.

CAD of robots is fine, full of parts that nobody sees, and seldom closed. Around it, at a distance that the padding
covers anyway, lies a surface that is smooth, closed and has few triangles, whatever the mesh was like.
"""

from __future__ import annotations

import logging

import manifold3d
import numpy as np
from numpy.typing import NDArray

from edge_unit.kernels import hull as kernels
from shared.meshes import TriangleMesh

logger = logging.getLogger(__name__)

HULL_M = 0.025
"""Distance of the hull from the mesh. Less would need a finer grid; more would leave no room for smaller paddings."""

GRID_M = 0.006
"""Spacing of the grid: a quarter of the distance resolves its bends."""

GRID_NODES_MAX = 2_000_000
"""8 MB of distances: beyond it (a link of 0.7 m edge) the grid is coarser."""

SAMPLE_M = 0.003
"""Spacing of the points that stand for the mesh; at the hull's distance it changes that by less than 0.1 mm."""

SIMPLIFY_M = 0.001
"""How far the simplified hull may leave the grid's."""


HULLS_MAX = 64
"""Hulls kept for meshes met again, as when the cell is sent anew: two arms with their tools."""

_hulls: dict[str, TriangleMesh] = {}


def hull_around(mesh: TriangleMesh) -> TriangleMesh:
    """The outer surface at `HULL_M` from `mesh`, within some 2 mm; closed, however open the mesh was.

    Takes a tenth of a second a link; the same mesh has its hull at once.
    """
    hull = _hulls.pop(mesh.sha256, None) or _make_hull(mesh)
    while len(_hulls) >= HULLS_MAX:
        del _hulls[next(iter(_hulls))]
    _hulls[mesh.sha256] = hull
    return hull


def _make_hull(mesh: TriangleMesh) -> TriangleMesh:
    """What `hull_around` keeps."""
    low = mesh.vertices.min(axis=0) - (HULL_M + 3.0 * GRID_M)
    size = mesh.vertices.max(axis=0) + (HULL_M + 3.0 * GRID_M) - low
    spacing_m = max(GRID_M, float((np.prod(size) / GRID_NODES_MAX) ** (1.0 / 3.0)))
    field = _distance(mesh, low, np.ceil(size / spacing_m).astype(int) + 1, spacing_m) - np.float32(HULL_M)
    outside = np.empty(field.shape, np.bool_)
    kernels.flood_outside(field < 0.0, outside, np.empty(field.size, np.int64))
    # A cavity is inside, too.
    field[~outside & (field >= 0.0)] = -spacing_m
    vertices, faces = _surface(field)
    return _simplified(mesh.name, (vertices * np.float32(spacing_m) + low).astype(np.float32), faces)


def _distance(
    mesh: TriangleMesh, origin_m: NDArray[np.float32], shape: NDArray[np.int64], spacing_m: float
) -> NDArray[np.float32]:
    """Distance (nx, ny, nz) in metres of the grid's nodes from the mesh, as far as it matters."""
    number = kernels.sample_faces(mesh.vertices, mesh.faces, SAMPLE_M, np.empty((0, 3), np.float32))
    samples_m = np.empty((number, 3), np.float32)
    kernels.sample_faces(mesh.vertices, mesh.faces, SAMPLE_M, samples_m)
    # Fine meshes give many more points than are needed; one of each grain will do.
    _, first = np.unique(np.floor(samples_m / SAMPLE_M).astype(np.int32), axis=0, return_index=True)
    reach = int(np.ceil((HULL_M + spacing_m) / spacing_m))
    far_m = HULL_M + 2.0 * spacing_m
    squared_m2 = np.full(tuple(shape), far_m * far_m, np.float32)
    kernels.spread_distance(samples_m[first], origin_m.astype(np.float32), np.float32(spacing_m), reach, squared_m2)
    return np.sqrt(squared_m2)


def _surface(field: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices (V, 3) in nodes and faces (F, 3) of the zero surface."""
    cells = np.empty(field.shape, np.int32)
    numbers = kernels.surface_net(field, cells, np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    vertices, faces = np.empty((numbers[0], 3), np.float32), np.empty((numbers[1], 3), np.int32)
    kernels.surface_net(field, cells, vertices, faces)
    return vertices, faces


def _simplified(name: str, vertices_m: NDArray[np.float32], faces: NDArray[np.int32]) -> TriangleMesh:
    """With as few triangles as `SIMPLIFY_M` allows."""
    solid = manifold3d.Manifold(manifold3d.Mesh(vertices_m, faces.astype(np.uint32)))
    if solid.status() == manifold3d.Error.NoError and solid.num_tri() > 0:
        found = solid.simplify(SIMPLIFY_M).to_mesh()
        vertices_m = np.ascontiguousarray(found.vert_properties[:, :3], np.float32)
        faces = np.ascontiguousarray(found.tri_verts, np.int32)
    else:
        logger.debug("%s: its hull touches itself and is drawn with all %d triangles", name, len(faces))
    return TriangleMesh(name, vertices_m, faces, closed=True)
