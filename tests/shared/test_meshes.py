# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import itertools
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from shared.errors import MeshError
from shared.meshes import (
    FILE_SUFFIXES,
    MAX_TRIANGLES,
    TriangleMesh,
    box_mesh,
    concatenated,
    cylinder_mesh,
    load_mesh,
    mesh_by_hash,
    sphere_mesh,
)
from shared.transforms import from_xyz_rpy

COLLADA = """<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><created>2026-01-01T00:00:00</created><modified>2026-01-01T00:00:00</modified>
    <unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
  <library_geometries><geometry id="g" name="g"><mesh>
    <source id="p"><float_array id="pa" count="12">0 0 0 10 0 0 0 10 0 0 0 10</float_array>
      <technique_common><accessor source="#pa" count="4" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
      <p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s">
    <node id="n1"><instance_geometry url="#g"/></node>
    <node id="n2"><translate>100 0 0</translate><instance_geometry url="#g"/></node>
  </visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""


def volume_m3(mesh: TriangleMesh) -> float:
    """Signed volume: positive when all faces of a closed mesh turn outwards."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def box_triangles(inside_out: bool = False) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    box = trimesh.creation.box(extents=(1.0, 2.0, 3.0))
    faces = np.asarray(box.faces, dtype=np.int64)
    return np.asarray(box.vertices, dtype=np.float64), faces[:, ::-1] if inside_out else faces


@pytest.mark.parametrize("suffix", FILE_SUFFIXES)
def test_every_format_gives_the_same_box(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"part{suffix}"
    trimesh.creation.box(extents=(1.0, 2.0, 3.0)).export(file)
    mesh = load_mesh(file)
    assert (len(mesh.vertices), len(mesh.faces), mesh.closed, mesh.name) == (8, 12, True, "part")
    np.testing.assert_allclose(mesh.bounds_m, [[-0.5, -1.0, -1.5], [0.5, 1.0, 1.5]])
    assert volume_m3(mesh) == pytest.approx(6.0)


def test_scale_takes_millimetres_and_keeps_mirrored_solids_outwards(tmp_path: Path) -> None:
    file = tmp_path / "part.stl"
    trimesh.creation.box(extents=(1000.0, 2000.0, 3000.0)).export(file)
    assert volume_m3(load_mesh(file, 0.001)) == pytest.approx(6.0)
    mirrored = load_mesh(file, (-0.001, 0.001, 0.002))
    assert mirrored.closed
    assert volume_m3(mirrored) == pytest.approx(12.0)


def test_mirrored_open_surface_keeps_its_front(tmp_path: Path) -> None:
    file = tmp_path / "sheet.obj"
    file.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    mesh = load_mesh(file, (1.0, -1.0, 1.0))
    a, b, c = mesh.vertices[mesh.faces[0]]
    # Its front looked along +z, which mirroring y leaves as it is.
    assert np.cross(b - a, c - a)[2] > 0.0


def test_parts_of_a_scene_have_the_poses_of_their_nodes_and_the_unit_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "scene.dae"
    file.write_text(COLLADA)
    mesh = load_mesh(file)
    assert (len(mesh.faces), mesh.closed) == (8, True)
    np.testing.assert_allclose(mesh.bounds_m, [[0.0, 0.0, 0.0], [1.1, 0.1, 0.1]], atol=1e-6)


def test_inside_out_solids_are_reversed_separately() -> None:
    vertices, faces = box_triangles()
    away = np.add(vertices, (10.0, 0.0, 0.0))
    turned = np.concatenate((faces, faces[:, ::-1] + len(vertices)))
    mesh = TriangleMesh.of_triangles("two", np.concatenate((vertices, away)), turned)
    assert not mesh.closed
    assert volume_m3(mesh) == pytest.approx(12.0)


def test_open_surface_is_kept_as_open() -> None:
    vertices, faces = box_triangles()
    mesh = TriangleMesh.of_triangles("lidless", vertices, faces[:-1])
    assert not mesh.closed
    assert len(mesh.faces) == 11


def test_one_reversed_triangle_makes_a_mesh_open() -> None:
    vertices, faces = box_triangles()
    faces = faces.copy()
    faces[3] = faces[3, ::-1]
    assert not TriangleMesh.of_triangles("flipped", vertices, faces).closed


def test_boxes_that_share_an_edge_are_closed() -> None:
    vertices, faces = box_triangles()
    both = np.concatenate((vertices, np.add(vertices, (1.0, 2.0, 0.0))))
    mesh = TriangleMesh.of_triangles("stairs", both, np.concatenate((faces, faces + len(vertices))))
    assert len(mesh.vertices) == 14
    assert mesh.closed


def test_repeated_vertices_are_merged_and_flat_triangles_dropped() -> None:
    vertices, faces = box_triangles()
    soup = vertices[faces.ravel()]
    flat = np.array([[0, 0, 1], [2, 2, 2]])
    mesh = TriangleMesh.of_triangles("soup", soup, np.concatenate((np.arange(36).reshape(12, 3), flat)))
    assert (len(mesh.vertices), len(mesh.faces), mesh.closed) == (8, 12, True)


def test_flat_triangle_in_a_seam_keeps_a_solid_closed() -> None:
    # A tetrahedron, one edge of which has a middle vertex on one side only, bridged by a triangle without area.
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2], [1, 0, 0]], dtype=np.float64)
    faces = np.array([[0, 2, 4], [4, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3], [0, 4, 1]])
    mesh = TriangleMesh.of_triangles("seam", vertices, faces)
    assert mesh.closed
    assert len(mesh.faces) == 5


def test_merging_does_not_depend_on_the_sign_of_zero() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, -0.0, 0], [0, 1, 0], [-1, 0, 0]])
    mesh = TriangleMesh.of_triangles("zero", vertices, np.array([[0, 1, 2], [3, 4, 5]]))
    assert len(mesh.vertices) == 4


def test_chain_of_touching_boxes_is_one_part() -> None:
    # A label must travel through all the boxes, each of which only touches the next.
    vertices, faces = box_triangles(inside_out=True)
    count = 300
    tower = np.concatenate([np.add(vertices, (0.0, 0.0, 3.0 * index)) for index in range(count)])
    mesh = TriangleMesh.of_triangles(
        "tower", tower, np.concatenate([faces + index * len(vertices) for index in range(count)])
    )
    assert len(mesh.vertices) == 4 * (count + 1)
    assert volume_m3(mesh) == pytest.approx(6.0 * count, rel=1e-3)


def test_primitives_have_their_size() -> None:
    box = box_mesh("b", (1.0, 2.0, 3.0))
    cylinder = cylinder_mesh("c", 0.1, 1.0)
    sphere = sphere_mesh("s", 0.1)
    assert box.closed
    assert cylinder.closed
    assert sphere.closed
    np.testing.assert_allclose(cylinder.bounds_m, [[-0.1, -0.1, -0.5], [0.1, 0.1, 0.5]], atol=1e-6)
    assert volume_m3(box) == pytest.approx(6.0)
    assert volume_m3(cylinder) == pytest.approx(np.pi * 0.01, rel=0.005)
    assert volume_m3(sphere) == pytest.approx(4.0 / 3.0 * np.pi * 0.001, rel=0.02)


def test_concatenation_and_transform() -> None:
    one, two = box_mesh("one", (1, 1, 1)), box_mesh("two", (1, 1, 1)).transformed(from_xyz_rpy((5, 0, 0), (0, 0, 1)))
    both = concatenated("both", [one, two])
    assert both.closed
    assert volume_m3(both) == pytest.approx(2.0, rel=1e-5)
    assert both.bounds_m[1][0] == pytest.approx(5.0 + np.sqrt(0.5) * np.cos(1.0 - np.pi / 4.0))
    sheet = TriangleMesh.of_triangles("sheet", np.eye(3), np.array([[0, 1, 2]]))
    assert not concatenated("mixed", [one, sheet]).closed


def test_bytes_round_trip_without_the_name() -> None:
    mesh = cylinder_mesh("c", 0.1, 1.0)
    again = TriangleMesh.from_bytes(mesh.to_bytes(), "other")
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    assert (again.closed, again.name, again.sha256) == (True, "other", mesh.sha256)
    assert mesh.sha256 != cylinder_mesh("c", 0.1, 1.1).sha256


def test_arrays_cannot_be_changed() -> None:
    mesh = box_mesh("b", (1, 1, 1))
    for array in (mesh.vertices, mesh.faces):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_mesh_by_hash_checks_the_hash() -> None:
    mesh, other = box_mesh("b", (1, 1, 1)), box_mesh("o", (2, 1, 1))
    assert mesh_by_hash({mesh.sha256: mesh.to_bytes()}, mesh.sha256, "b").sha256 == mesh.sha256
    with pytest.raises(MeshError, match=r"mesh b: expected bytes with sha256 \w+, got none"):
        mesh_by_hash({}, mesh.sha256, "b")
    with pytest.raises(MeshError, match=f"mesh b: expected bytes with sha256 {mesh.sha256}, got {other.sha256}"):
        mesh_by_hash({mesh.sha256: other.to_bytes()}, mesh.sha256, "b")


@given(st.data())
def test_damaged_bytes_are_refused_or_a_valid_mesh(data: st.DataObject) -> None:
    good = box_mesh("b", (1, 1, 1)).to_bytes()
    damaged = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(good) + 8))
    blob = bytes(damaged[:cut]) + b"\0" * max(0, cut - len(good))
    try:
        mesh = TriangleMesh.from_bytes(blob, "b")
    except MeshError:
        return
    assert mesh.to_bytes() == blob
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)


@pytest.mark.parametrize(
    ("header", "body", "words"),
    [
        ((b"CWM1", 1, 3, 1), 0, "expected 64 bytes by its header, got 16"),
        ((b"CWM1", 1, 3, MAX_TRIANGLES + 1), 0, "expected at most"),
        ((b"CWM1", 1, 2**32 - 1, 1), 0, "expected at most"),
        ((b"CWM1", 2, 3, 1), 48, "expected bytes that begin with"),
        ((b"CWM2", 1, 3, 1), 48, "expected bytes that begin with"),
        ((b"CWM1", 1, 3, 0), 36, "expected at least one triangle"),
        ((b"CWM1", 1, 0, 1), 12, "expected face indices"),
    ],
)
def test_malformed_headers_are_refused(header: tuple[bytes, int, int, int], body: int, words: str) -> None:
    with pytest.raises(MeshError, match=words):
        TriangleMesh.from_bytes(struct.pack("<4sIII", *header) + b"\0" * body, "m")


BAD_FILES = {
    "empty.stl": (b"", "expected an STL file of at least 84 bytes, got 0"),
    "hollow.stl": (b"solid x\nendsolid x\n", "expected a mesh with triangles, got none"),
    "noise.stl": (bytes(range(200)), "got 200; it is cut off, or no STL"),
    "cut.stl": (b"\0" * 80 + struct.pack("<I", 9) + b"\0" * 50, "expected 534 bytes for 9 triangles, got 134"),
    "index.obj": (b"v 0 0 0\nf 1 2 3\n", "expected a readable mesh"),
    "header.ply": (b"ply\n", "expected a readable mesh"),
    "broken.dae": (b"<COLLADA>", "expected a readable mesh"),
    "flat.obj": (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "expected triangles with an area, got 1 without"),
    "nan.obj": (b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "expected finite coordinates"),
    "huge.obj": (b"v 0 0 1e300\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "expected finite coordinates"),
    "mm.obj": (b"v 0 0 0\nv 2000 0 0\nv 0 1 0\nf 1 2 3\n", "for a file in millimetres set scale 0.001"),
    "part.step": (b"x", "expected a mesh file"),
    "part": (b"x", "expected a mesh file"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file_is_one_sentence_that_names_it(tmp_path: Path, name: str) -> None:
    content, words = BAD_FILES[name]
    file = tmp_path / name
    file.write_bytes(content)
    with pytest.raises(MeshError, match=words) as caught:
        load_mesh(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)


def test_missing_file_folder_and_scale_are_named(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"gone\.stl: expected a mesh file, got no such file"):
        load_mesh(tmp_path / "gone.stl")
    (tmp_path / "folder.stl").mkdir()
    with pytest.raises(MeshError, match=r"folder\.stl: expected a mesh file, got a folder"):
        load_mesh(tmp_path / "folder.stl")
    for scale in (0.0, float("nan"), (1.0, 2.0)):
        with pytest.raises(MeshError, match="expected a scale of one or three numbers"):
            load_mesh(tmp_path / "gone.stl", scale)


def test_more_triangles_than_the_limit_are_refused() -> None:
    faces = np.zeros((MAX_TRIANGLES + 1, 3), dtype=np.int32)
    with pytest.raises(MeshError, match="expected at most 1000000 triangles, got 1000001"):
        TriangleMesh("m", np.zeros((3, 3), dtype=np.float32), faces, closed=False)


@given(st.permutations(range(12)), st.integers(0, 2))
def test_order_of_triangles_does_not_matter_to_closedness(order: list[int], shift: int) -> None:
    vertices, faces = box_triangles()
    shuffled = np.roll(faces[list(order)], shift, axis=1)
    for inside_out in (False, True):
        mesh = TriangleMesh.of_triangles("b", vertices, shuffled[:, ::-1] if inside_out else shuffled)
        assert mesh.closed is not inside_out
        assert volume_m3(mesh) == pytest.approx(6.0)


def test_every_edge_of_a_box_is_shared() -> None:
    mesh = box_mesh("b", (1, 1, 1))
    edges = [tuple(sorted((int(f[i]), int(f[j])))) for f in mesh.faces for i, j in itertools.combinations(range(3), 2)]
    assert all(edges.count(edge) == 2 for edge in edges)


def binary_stl(tmp_path: Path, *, header: bytes = b"", extra: int = 0, lost: int = 0) -> Path:
    content = trimesh.creation.box(extents=(0.2, 0.3, 0.4)).export(file_type="stl")
    assert isinstance(content, bytes)
    file = tmp_path / "box.stl"
    whole = header.ljust(80, b" ") + content[80:] + bytes(extra)
    file.write_bytes(whole[: len(whole) - lost])
    return file


@pytest.mark.parametrize(("header", "extra"), [(b"", 0), (b"", 1), (b"", 10), (b"solid of a CAD", 0), (b"solid", 3)])
def test_a_binary_stl_is_read_as_far_as_its_header_counts(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, header: bytes, extra: int
) -> None:
    mesh = load_mesh(binary_stl(tmp_path, header=header, extra=extra))
    assert (len(mesh.faces), mesh.closed) == (12, True)
    assert (f"passed over {extra} bytes" in caplog.text) == (extra > 0)


def test_a_cut_off_stl_is_refused_with_its_bytes(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="expected 684 bytes for 12 triangles, got 683; it is cut off"):
        load_mesh(binary_stl(tmp_path, lost=1))
    with pytest.raises(MeshError, match="at least 84 bytes, got 80"):
        load_mesh(binary_stl(tmp_path, lost=604))


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".dae"])
def test_a_pointer_of_git_lfs_is_named_as_one(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"arm{suffix}"
    file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n")
    with pytest.raises(MeshError, match="Git LFS pointer"):
        load_mesh(file)


def test_a_glb_is_read(tmp_path: Path) -> None:
    trimesh.creation.box(extents=(0.2, 0.3, 0.4)).export(tmp_path / "box.glb")
    mesh = load_mesh(tmp_path / "box.glb")
    assert mesh.closed
    np.testing.assert_allclose(mesh.bounds_m[1], (0.1, 0.15, 0.2), atol=1e-6)


def shell(size_m: float, *, inwards: bool = False, at_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a cube."""
    cube = box_mesh("cube", (size_m, size_m, size_m))
    return cube.vertices + np.float32((at_m, 0, 0)), cube.faces[:, ::-1] if inwards else cube.faces


def joined(*shells: tuple[np.ndarray, np.ndarray]) -> TriangleMesh:
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in shells[:-1]])
    return TriangleMesh.of_triangles(
        "joined",
        np.concatenate([vertices for vertices, _ in shells]),
        np.concatenate([faces + start for (_, faces), start in zip(shells, starts, strict=True)]),
    )


def test_a_hollow_keeps_facing_inwards() -> None:
    room = joined(shell(4.0), shell(3.0, inwards=True))
    assert room.closed
    assert volume_m3(room) == pytest.approx(64.0 - 27.0)
    nested = joined(shell(4.0), shell(3.0, inwards=True), shell(1.0), shell(0.5, inwards=True))
    assert nested.closed
    assert volume_m3(nested) == pytest.approx(64.0 - 27.0 + 1.0 - 0.125)


def test_a_hollow_in_one_part_of_many_is_found() -> None:
    parts = [shell(1.0, at_m=2.0 * i) for i in range(20)]
    mesh = joined(*parts, shell(0.5, inwards=True, at_m=14.0))
    assert mesh.closed
    assert volume_m3(mesh) == pytest.approx(20.0 - 0.125)


def test_a_part_that_faces_inwards_is_turned_and_drawn_from_both_sides() -> None:
    """It is a solid exported inside out, or a room's inner surface; the file cannot tell."""
    for mesh, volume in (
        (joined(shell(2.0, inwards=True)), 8.0),
        (joined(shell(2.0), shell(1.0, inwards=True, at_m=5.0)), 9.0),
    ):
        assert not mesh.closed
        assert volume_m3(mesh) == pytest.approx(volume)
