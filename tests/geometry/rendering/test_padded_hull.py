# SPDX-License-Identifier: Apache-2.0
"""The solid around a link: at the right distance, closed, and small, for any mesh."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import trimesh

from geometry.kernels import hull as kernels
from geometry.rendering import hull_around, padded_hull
from geometry.rendering.padded_hull import DISTANCE_MIN_M
from shared.cell import Cell
from shared.errors import InputError
from shared.meshes import TriangleMesh, box_mesh, cylinder_mesh, sphere_mesh

HULL_M = 0.05

DEMO_CELL = "assets/cells/demo/cell.yaml"

TOLERANCE_M = 0.0035
"""Tolerance of the grid, the surface net and the simplification together."""


def solid(mesh: TriangleMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def distances_m(hull: TriangleMesh, mesh: TriangleMesh) -> np.ndarray:
    points, _ = trimesh.sample.sample_surface(solid(hull), 800, seed=1)
    return np.asarray(trimesh.proximity.closest_point(solid(mesh), points)[1])


@pytest.mark.parametrize(
    "mesh",
    [box_mesh("box", (0.1, 0.05, 0.3)), cylinder_mesh("cylinder", 0.04, 0.2), sphere_mesh("sphere", 0.06)],
    ids=["box", "cylinder", "sphere"],
)
def test_the_hull_is_at_its_distance(mesh: TriangleMesh) -> None:
    hull = hull_around(mesh, HULL_M)
    assert np.abs(distances_m(hull, mesh) - HULL_M).max() < TOLERANCE_M


def test_links_of_a_robot() -> None:
    robot = Cell.load(DEMO_CELL).robot
    assert robot is not None
    for link in robot.links:
        hull = hull_around(link.mesh, HULL_M)
        assert np.abs(distances_m(hull, link.mesh) - HULL_M).max() < TOLERANCE_M
        assert solid(hull).is_watertight
        assert solid(hull).volume > 0.0


def test_an_open_mesh_with_inner_parts_has_a_closed_hull_of_its_outside() -> None:
    outer, inner = box_mesh("box", (0.2, 0.04, 0.2)), sphere_mesh("sphere", 0.01)
    # The opening is narrower than twice the distance.
    normals = np.asarray(solid(outer).face_normals)
    open_faces = outer.faces[normals[:, 2] < 0.5]
    mesh = TriangleMesh(
        "open",
        np.vstack((outer.vertices, inner.vertices)),
        np.vstack((open_faces, inner.faces + np.int32(len(outer.vertices)))),
        closed=False,
    )
    hull = solid(hull_around(mesh, HULL_M))
    assert hull.is_watertight
    assert hull.body_count == 1


def test_a_closed_shell_is_filled() -> None:
    """Its cavity is wider than twice the distance, and yet there is one surface only."""
    hull = solid(hull_around(box_mesh("box", (0.3, 0.3, 0.3)), HULL_M))
    assert hull.body_count == 1
    assert hull.volume > 0.3**3


def test_the_hull_has_few_triangles() -> None:
    fine = sphere_mesh("sphere", 0.1)
    for _ in range(2):
        dense = solid(fine).subdivide()
        fine = TriangleMesh(
            "fine", np.asarray(dense.vertices, np.float32), np.asarray(dense.faces, np.int32), closed=True
        )
    assert len(hull_around(fine, HULL_M).faces) < min(3000, len(fine.faces))


def test_the_same_mesh_has_its_hull_at_once() -> None:
    mesh = box_mesh("box", (0.1, 0.1, 0.1))
    assert hull_around(mesh, HULL_M) is hull_around(box_mesh("box", (0.1, 0.1, 0.1)), HULL_M)


def test_samples_cover_a_triangle() -> None:
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.07, 0]], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    number = kernels.sample_faces(vertices, faces, 0.003, 0, np.empty((0, 3), np.float32))
    samples = np.empty((number, 3), np.float32)
    assert kernels.sample_faces(vertices, faces, 0.003, 0, samples) == number
    rng = np.random.default_rng(0)
    share = rng.dirichlet((1, 1, 1), 500)
    points = share @ vertices
    nearest = np.linalg.norm(points[:, None] - samples[None], axis=2).min(axis=1)
    assert nearest.max() <= 0.003


def test_samples_do_not_depend_on_the_number_taken_at_once() -> None:
    mesh = box_mesh("box", (0.1, 0.02, 0.3))
    number = kernels.sample_faces(mesh.vertices, mesh.faces, 0.004, 0, np.empty((0, 3), np.float32))
    every = np.empty((number, 3), np.float32)
    kernels.sample_faces(mesh.vertices, mesh.faces, 0.004, 0, every)
    for size in (1, 700, number - 1, number, number + 5):
        for first in range(0, number, max(size, number // 7)):
            some = np.full((size, 3), np.nan, np.float32)
            assert kernels.sample_faces(mesh.vertices, mesh.faces, 0.004, first, some) == number
            np.testing.assert_array_equal(some[: number - first], every[first : first + size])
            assert np.isnan(some[number - first :]).all()


def test_a_mesh_that_is_sampled_in_parts_is_no_farther(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each part gives a sample of a grain in several parts; all samples of a single pass are among them."""
    mesh = cylinder_mesh("cylinder", 0.1, 0.4)
    grid = np.full(3, -0.2, np.float32), np.array((50, 50, 70)), 0.25 * HULL_M, HULL_M
    whole_m = padded_hull._distance(mesh, *grid)
    monkeypatch.setattr(padded_hull, "SAMPLES_AT_ONCE", 1000)
    parts_m = padded_hull._distance(mesh, *grid)
    assert (parts_m <= whole_m).all()
    at_hull = np.abs(whole_m - HULL_M) < 0.25 * HULL_M
    assert at_hull.any()
    assert (whole_m - parts_m)[at_hull].max() < 0.01 * HULL_M


def slivers(number: int) -> TriangleMesh:
    """Return a cylinder of 1.2 m as in CAD: two long triangles for each of many sides."""
    turn = np.linspace(0.0, 2.0 * np.pi, number, endpoint=False)
    ring = 0.3 * np.stack((np.cos(turn), np.sin(turn)), axis=1)
    vertices = np.vstack([np.column_stack((ring, np.full(number, z))) for z in (0.0, 1.2)]).astype(np.float32)
    this = np.arange(number)
    following = (this + 1) % number
    faces = np.vstack(
        (
            np.column_stack((this, following, this + number)),
            np.column_stack((following, following + number, this + number)),
        )
    )
    return TriangleMesh("slivers", vertices, faces.astype(np.int32), closed=False)


def test_a_large_mesh_takes_little_memory() -> None:
    mesh = slivers(60)
    number = kernels.sample_faces(mesh.vertices, mesh.faces, 0.1 * HULL_M, 0, np.empty((0, 3), np.float32))
    assert number > 3 * padded_hull.SAMPLES_AT_ONCE
    tracemalloc.start()
    try:
        padded_hull.make_hull(mesh, HULL_M)
        assert tracemalloc.get_traced_memory()[1] < 150e6
    finally:
        tracemalloc.stop()


def test_distances_are_those_of_the_nearest_sample() -> None:
    rng = np.random.default_rng(1)
    samples = rng.uniform(0.02, 0.08, (40, 3)).astype(np.float32)
    origin, spacing = np.zeros(3, np.float32), np.float32(0.01)
    squared = np.full((11, 11, 11), 0.02**2, np.float32)
    kernels.spread_distance(samples, origin, spacing, 3, squared)
    nodes = np.stack(np.meshgrid(*[np.arange(11) * 0.01] * 3, indexing="ij"), axis=-1)
    twin = np.linalg.norm(nodes[..., None, :] - samples, axis=-1).min(axis=-1)
    np.testing.assert_allclose(np.sqrt(squared), np.minimum(twin, 0.02), atol=1e-5)


def test_outside_is_connected_with_the_corner() -> None:
    inside = np.zeros((9, 9, 9), np.bool_)
    inside[2:7, 2:7, 2:7] = True
    inside[3:6, 3:6, 3:6] = False
    outside = np.empty_like(inside)
    kernels.flood_outside(inside, outside, np.empty(inside.size, np.int64))
    expected = np.ones_like(inside)
    expected[2:7, 2:7, 2:7] = False
    assert (outside == expected).all()


def test_the_net_of_a_ball_is_a_ball() -> None:
    nodes = np.stack(np.meshgrid(*[np.arange(21.0)] * 3, indexing="ij"), axis=-1)
    field = (np.linalg.norm(nodes - 10.0, axis=-1) - 7.3).astype(np.float32)
    cells = np.empty(field.shape, np.int32)
    vertex_number, face_number = kernels.surface_net(
        field, cells, np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)
    )
    vertices, faces = np.empty((vertex_number, 3), np.float32), np.empty((face_number, 3), np.int32)
    assert kernels.surface_net(field, cells, vertices, faces) == (vertex_number, face_number)
    ball = trimesh.Trimesh(vertices, faces, process=False)
    assert ball.is_watertight
    assert np.abs(np.linalg.norm(vertices - 10.0, axis=1) - 7.3).max() < 0.1
    assert ball.volume == pytest.approx(4 / 3 * np.pi * 7.3**3, rel=0.03)


def test_an_empty_field_has_no_surface() -> None:
    field = np.ones((5, 5, 5), np.float32)
    none = np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)
    assert kernels.surface_net(field, np.empty(field.shape, np.int32), *none) == (0, 0)


def test_a_distance_below_the_least_is_refused() -> None:
    with pytest.raises(InputError, match=f"box.*at least {DISTANCE_MIN_M} m"):
        hull_around(box_mesh("box", (0.1, 0.1, 0.1)), 0.001)
