# SPDX-License-Identifier: Apache-2.0
"""The closed surface at a padding's distance around a link, which represents the robot in the filter.

CAD of robots is fine, has many invisible inner parts, and is seldom closed. The surface at some distance around it is
smooth and closed and has few triangles, for any mesh.
"""

from __future__ import annotations

import importlib.metadata
import logging
from functools import lru_cache
from pathlib import Path

import manifold3d
import numpy as np
from numpy.typing import NDArray

from geometry.compilation.cache import folder_beside
from geometry.kernels import hull as kernels
from geometry.rendering.hull_store import FOLDER, HullStore, state_of_code
from shared.errors import InputError
from shared.meshes import TriangleMesh

logger = logging.getLogger(__name__)

DISTANCE_MIN_M = 0.015
"""Least distance: a nearer hull would need a grid too fine for its size."""

GRID_SHARE = 0.25
"""Grid spacing as a share of the distance, which is the smallest radius of curvature of the hull."""

GRID_NODES_MAX = 2_000_000
"""Limit of grid nodes: 8 MB of distances; the grid of a larger link is coarser."""

SAMPLE_SHARE = 0.1
"""Spacing of the sample points of the mesh as a share of the distance; the error of the distance is below 1 %."""

SAMPLES_AT_ONCE = 1_000_000
"""Samples processed at once: about 60 MB while they are thinned out. Long, thin triangles, which CAD is full of, get
many more samples than necessary: all at once took 1.7 GB for a smooth cylinder of 1.2 m."""

SIMPLIFY_MAX_M, SIMPLIFY_SHARE = 0.002, 1.0 / 15.0
"""Tolerance of the simplification, absolute and as a share of the distance. Half of it would mean nearly twice as many
triangles to draw."""

LIFT = 0.25
"""Pre-inflate by this share of the tolerance, since the simplification cuts convex corners."""

HULLS_MAX = 64
"""Limit of hulls in memory for meshes that come again, for example when the cell is sent again: two arms with tools."""

_hulls: dict[tuple[str, float], TriangleMesh] = {}


def hull_around(mesh: TriangleMesh, distance_m: float) -> TriangleMesh:
    """Return the outer surface at `distance_m` from `mesh`, within about 3 mm; closed even when the mesh is open.

    It takes some hundredths of a second, and seconds for fine CAD of a large link. The hull of the same mesh is then in
    memory, and at the next start on the disk.

    Raises:
        InputError: the distance is below `DISTANCE_MIN_M`.
    """
    if not distance_m >= DISTANCE_MIN_M:
        raise InputError(f"hull of {mesh.name}: expected a distance of at least {DISTANCE_MIN_M} m, got {distance_m}")
    hull = _hulls.pop((mesh.sha256, distance_m), None) or _kept_hull(mesh, distance_m)
    while len(_hulls) >= HULLS_MAX:
        del _hulls[next(iter(_hulls))]
    _hulls[mesh.sha256, distance_m] = hull
    return hull


@lru_cache(maxsize=1)
def _store() -> HullStore:
    sources = (Path(__file__), Path(kernels.__file__))
    libraries = (f"{name} {importlib.metadata.version(name)}" for name in ("manifold3d", "numpy"))
    return HullStore(folder_beside(FOLDER), state_of_code(sources, libraries))


def _kept_hull(mesh: TriangleMesh, distance_m: float) -> TriangleMesh:
    """Return the hull from the disk, or make and store it."""
    store = _store()
    hull = store.load(mesh, distance_m)
    if hull is None:
        hull = make_hull(mesh, distance_m)
        store.save(mesh, distance_m, hull)
    return hull


def make_hull(mesh: TriangleMesh, distance_m: float) -> TriangleMesh:
    """Make the hull of `hull_around`, without a look at the disk."""
    grid_m = GRID_SHARE * distance_m
    low = mesh.vertices.min(axis=0) - np.float32(distance_m + 3.0 * grid_m)
    size = mesh.vertices.max(axis=0) + np.float32(distance_m + 3.0 * grid_m) - low
    grid_m = max(grid_m, float((np.prod(size) / GRID_NODES_MAX) ** (1.0 / 3.0)))
    shape = np.ceil(size / grid_m).astype(int) + 1
    simplify_m = min(SIMPLIFY_MAX_M, SIMPLIFY_SHARE * distance_m)
    lifted_m = distance_m + LIFT * simplify_m
    field = _distance(mesh, low, shape, grid_m, lifted_m) - np.float32(lifted_m)
    outside = np.empty(field.shape, np.bool_)
    kernels.flood_outside(field < 0.0, outside, np.empty(field.size, np.int64))
    # A cavity belongs to the inside.
    field[~outside & (field >= 0.0)] = -grid_m
    vertices, faces = _surface(field)
    return _simplified(mesh.name, (vertices * np.float32(grid_m) + low).astype(np.float32), faces, simplify_m)


def _distance(
    mesh: TriangleMesh, origin_m: NDArray[np.float32], shape: NDArray[np.int64], grid_m: float, distance_m: float
) -> NDArray[np.float32]:
    """Return the distance (nx, ny, nz), metres, of the grid's nodes from the mesh, cut above about `distance_m`."""
    spacing_m = SAMPLE_SHARE * distance_m
    reach = int(np.ceil((distance_m + grid_m) / grid_m))
    far_m = distance_m + 2.0 * grid_m
    squared_m2 = np.full(tuple(shape), far_m * far_m, np.float32)
    number = kernels.sample_faces(mesh.vertices, mesh.faces, spacing_m, 0, np.empty((0, 3), np.float32))
    for start in range(0, number, SAMPLES_AT_ONCE):
        samples_m = np.empty((min(SAMPLES_AT_ONCE, number - start), 3), np.float32)
        kernels.sample_faces(mesh.vertices, mesh.faces, spacing_m, start, samples_m)
        samples_m = _thinned(samples_m, 0.5 * spacing_m)
        kernels.spread_distance(samples_m, origin_m.astype(np.float32), np.float32(grid_m), reach, squared_m2)
    return np.sqrt(squared_m2)


def _thinned(samples_m: NDArray[np.float32], grain_m: float) -> NDArray[np.float32]:
    """Return one of the points (S, 3) for each grain; fine meshes give many more than necessary."""
    grain = np.floor(samples_m / grain_m).astype(np.int64)
    grain -= grain.min(axis=0)
    _, first = np.unique(np.ravel_multi_index(tuple(grain.T), tuple(grain.max(axis=0) + 1)), return_index=True)
    return samples_m[first]


def _surface(field: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return vertices (V, 3), in nodes, and faces (F, 3) of the zero surface."""
    cells = np.empty(field.shape, np.int32)
    numbers = kernels.surface_net(field, cells, np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    vertices, faces = np.empty((numbers[0], 3), np.float32), np.empty((numbers[1], 3), np.int32)
    kernels.surface_net(field, cells, vertices, faces)
    return vertices, faces


def _simplified(
    name: str, vertices_m: NDArray[np.float32], faces: NDArray[np.int32], tolerance_m: float
) -> TriangleMesh:
    """Return the mesh with as few triangles as `tolerance_m` allows."""
    solid = manifold3d.Manifold(manifold3d.Mesh(vertices_m, faces.astype(np.uint32)))
    if solid.status() == manifold3d.Error.NoError and solid.num_tri() > 0:
        found = solid.simplify(tolerance_m).to_mesh()
        vertices_m = np.ascontiguousarray(found.vert_properties[:, :3], np.float32)
        faces = np.ascontiguousarray(found.tri_verts, np.int32)
    else:
        logger.debug("%s: its hull touches itself and is drawn with all %d triangles", name, len(faces))
    return TriangleMesh(name, vertices_m, faces, closed=True)
