# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

from geometry.rendering.vertex_offsets import OFFSET_MAX, vertex_offsets
from shared.meshes import TriangleMesh, box_mesh, cylinder_mesh, sphere_mesh
from tests.edge_unit.scenes import demo_cell

LINKS = [link.mesh for link in demo_cell().robot.links]
SOLIDS = [box_mesh("box", (0.3, 0.2, 0.1)), sphere_mesh("sphere", 0.1), cylinder_mesh("cylinder", 0.05, 0.4)]


def seen_from_around(shape: trimesh.Trimesh, count: int = 3000) -> NDArray[np.float64]:
    """Return the first hits of rays from all directions; inner faces of joined parts do not count."""
    rng = np.random.default_rng(0)
    low, high = shape.bounds
    targets = rng.uniform(low, high, (4 * count, 3))
    directions = rng.normal(size=targets.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits, _, _ = RayMeshIntersector(shape).intersects_location(targets - 3.0 * directions, directions, False)
    return np.asarray(hits[:count])


def growth_m(mesh: TriangleMesh, padding_m: float) -> NDArray[np.float64]:
    """Return the distances of points all over the inflated surface from the original one."""
    inflated = trimesh.Trimesh(mesh.vertices + padding_m * vertex_offsets(mesh), mesh.faces, process=False)
    original = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return np.asarray(trimesh.proximity.closest_point(original, seen_from_around(inflated))[1])


@pytest.mark.parametrize("mesh", [*SOLIDS, *LINKS], ids=lambda mesh: mesh.name)
def test_surfaces_move_out_by_about_the_padding(mesh: TriangleMesh) -> None:
    distance_m = growth_m(mesh, 0.05)
    print(mesh.name, np.percentile(distance_m / 0.05, [0, 0.5, 1, 5, 50, 100]).round(2), len(mesh.faces))
    assert (distance_m >= 0.8 * 0.05).mean() >= 0.99
    assert distance_m.max() <= OFFSET_MAX * 0.05 + 1e-6


def test_faces_of_a_box_move_by_the_padding_itself() -> None:
    """Averaged normals would move them by 58 % of it."""
    mesh = box_mesh("box", (0.3, 0.2, 0.1))
    inflated = mesh.vertices + 0.03 * vertex_offsets(mesh)
    assert np.allclose(np.ptp(inflated, axis=0), (0.36, 0.26, 0.16), atol=5e-4)


def test_the_motion_of_a_needles_tip_is_bounded() -> None:
    cone = trimesh.creation.cone(radius=0.002, height=0.3, sections=16)
    mesh = TriangleMesh.of_triangles("needle", cone.vertices, cone.faces)
    assert np.linalg.norm(vertex_offsets(mesh), axis=1).max() <= OFFSET_MAX + 1e-6


def test_an_open_sheet_and_unused_vertices_stay_finite() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]], np.float32)
    sheet = TriangleMesh("sheet", points, np.array([[0, 1, 2], [0, 2, 3]]), closed=False)
    offsets = vertex_offsets(sheet)
    assert offsets.dtype == np.float32
    assert np.allclose(offsets[:4], (0, 0, 1), atol=1e-2)
    assert np.allclose(offsets[4], 0.0)


def test_a_face_without_an_area_moves_nothing() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, 0, 0]], np.float32)
    mesh = TriangleMesh("flat", points, np.array([[0, 1, 2], [0, 3, 1]]), closed=False)
    assert np.isfinite(vertex_offsets(mesh)).all()
