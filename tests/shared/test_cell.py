# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import shutil
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import trimesh

from shared.cell import Board, Cell, PlacedMesh
from shared.errors import CellError, ConfigError, InputError
from shared.kinematics import Robot
from shared.meshes import box_mesh
from shared.transforms import apply, from_xyz_rpy, identity, inverse

CELLS = Path(__file__).resolve().parents[2] / "assets" / "cells"
REST = (0.0, -1.9, 1.9, -1.57, -1.57, 0.0)


@pytest.fixture(scope="module")
def demo() -> Cell:
    return Cell.load(CELLS / "demo" / "cell.yaml")


def written(folder: Path, text: str, head: str = "name: c\nbox: {min: [-1, -1, -1], max: [1, 1, 1]}\n") -> Path:
    file = folder / "cell.yaml"
    file.write_text(head + text)
    return file


def test_demo_cell_is_complete(demo: Cell) -> None:
    assert demo.name == "demo"
    np.testing.assert_array_equal(demo.box_min_m, [-1.5, -1.5, -0.75])
    np.testing.assert_array_equal(demo.box_max_m, [1.5, 1.5, 1.5])
    assert [body.name for body in demo.static] == ["floor", "table", "shelf"]
    assert [body.name for body in demo.objects] == ["tray"]
    assert all(body.mesh.closed for body in (*demo.static, *demo.objects))
    assert demo.robot is not None
    assert [(link.name, link.moving) for link in demo.robot.links] == [
        ("base_link_inertia", False),
        ("shoulder_link", True),
        ("upper_arm_link", True),
        ("forearm_link", True),
        ("wrist_1_link", True),
        ("wrist_2_link", True),
        ("wrist_3_link", True),
        ("tool", True),
    ]
    assert all(link.mesh.closed for link in demo.robot.links)
    np.testing.assert_array_equal(demo.robot.T_world_base, np.eye(4))


@pytest.mark.parametrize("path", [None, 5, b"x"])
def test_invalid_path_types_raise_one_clear_error(path: Any) -> None:
    with pytest.raises(CellError) as caught:
        Cell.load(path)
    assert str(caught.value) == f"cell: expected the path of a cell file as text or Path, got {type(path).__name__}"


def world_bounds_m(body: PlacedMesh) -> list[list[float]]:
    points = apply(body.T_world_mesh, body.mesh.vertices)
    return [points.min(axis=0).tolist(), points.max(axis=0).tolist()]


def test_demo_furniture_stands_on_the_floor_and_the_table(demo: Cell) -> None:
    floor, table, shelf = (world_bounds_m(body) for body in demo.static)
    (tray,) = (world_bounds_m(body) for body in demo.objects)
    assert floor[1][2] == pytest.approx(-0.75)
    assert table == [pytest.approx([-0.25, -0.4, -0.75]), pytest.approx([0.95, 0.4, 0.0])]
    assert shelf[0][2] == pytest.approx(-0.75)
    assert tray[0][2] == pytest.approx(0.0)
    inside = (*table, *shelf, *tray)
    assert all((np.array(corner) > demo.box_min_m - 1e-9).all() for corner in inside)
    assert all((np.array(corner) < demo.box_max_m).all() for corner in inside)


def test_demo_links_match_the_visual_meshes(demo: Cell) -> None:
    # Its link meshes are placed by hand; wrong by a turn, they would miss the URDF's visual meshes by centimetres.
    package = importlib.util.find_spec("airo_models")
    assert package is not None
    assert package.submodule_search_locations is not None
    visual = Robot.from_urdf(Path(package.submodule_search_locations[0]) / "arms/ur3e/ur3e.urdf", "visual")
    assert demo.robot is not None
    for ours, theirs in zip(demo.robot.links[1:-1], visual.links[1:], strict=True):
        assert ours.name == theirs.name
        np.testing.assert_allclose(ours.mesh.bounds_m, theirs.mesh.bounds_m, atol=5e-4)


def test_demo_gripper_is_12_cm_long_and_points_out_of_the_flange(demo: Cell) -> None:
    assert demo.robot is not None
    tool = demo.robot.links[-1]
    T_flange_tool = inverse(demo.robot.frame_pose("tool0", REST)) @ demo.robot.link_poses(REST)[-1]
    points = apply(T_flange_tool, tool.mesh.vertices)
    assert points[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert points[:, 2].max() == pytest.approx(0.12, abs=1e-6)


def test_demo_board_lies_on_the_table_printed_side_up(demo: Cell) -> None:
    assert demo.board is not None
    board = demo.board
    assert (board.kind, board.columns, board.rows, board.dictionary) == ("grid", 8, 6, "DICT_4X4_50")
    gap_m = board.square_m - board.marker_m
    far = (board.columns * board.square_m - gap_m, board.rows * board.square_m - gap_m, 0.0)
    corners = apply(board.T_world_board, np.array([(0.0, 0.0, 0.0), far]))
    np.testing.assert_allclose(corners[:, 2], 0.0, atol=1e-9)
    table = next(each for each in demo.static if each.name == "table")
    top_m = apply(table.T_world_mesh, table.mesh.vertices)[:, :2]
    assert (corners[:, :2] > top_m.min(axis=0)).all()
    assert (corners[:, :2] < top_m.max(axis=0)).all()
    np.testing.assert_allclose(board.T_world_board[:3, 2], [0.0, 0.0, -1.0], atol=1e-12)


def test_demo_meshes_match_the_output_of_their_script(tmp_path: Path) -> None:
    script = shutil.copy(CELLS / "demo" / "make_meshes.py", tmp_path)
    spec = importlib.util.spec_from_file_location("make_meshes", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name, blocks in (("table", (module.table(),)), ("shelf", (module.shelf(),)), ("tray", (module.tray(),))):
        module.write(name, *blocks)
    module.write("gripper_mm", *module.gripper())
    for file in tmp_path.glob("*.stl"):
        ours, again = trimesh.load_mesh(CELLS / "demo" / file.name), trimesh.load_mesh(file)
        np.testing.assert_allclose(ours.triangles, again.triangles, atol=1e-6)
    assert len(list(tmp_path.glob("*.stl"))) == len(list((CELLS / "demo").glob("*.stl"))) == 4


def test_cell_of_the_real_recordings(data_dir: Path) -> None:
    cell = Cell.load(CELLS / "xarm7" / "cell.yaml")
    assert (cell.static, cell.objects, cell.board) == ((), (), None)
    assert cell.robot is not None
    assert cell.robot.joint_count == 7
    assert len(cell.robot.links) == 8
    assert cell.lattice(0.05).shape == (60, 60, 40)


def test_variable_that_is_not_set_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CELLWATCH_DATA", raising=False)
    words = r"xarm7/cell\.yaml: robot\.urdf: expected the environment variable CELLWATCH_DATA to be set"
    with pytest.raises(CellError, match=words):
        Cell.load(CELLS / "xarm7" / "cell.yaml")


def test_document_round_trip(demo: Cell) -> None:
    document, meshes = demo.to_document()
    for carried in (json.loads(json.dumps(document)), msgpack.unpackb(msgpack.packb(document))):
        again = Cell.from_document(carried, meshes)
        assert again.to_document() == (document, meshes)
        assert again.version == demo.version
        assert again.robot is not None
        assert demo.robot is not None
        np.testing.assert_array_equal(again.robot.link_poses(REST), demo.robot.link_poses(REST))
        assert again.board is not None
        assert demo.board is not None
        assert again.board.to_document() == demo.board.to_document()
        np.testing.assert_array_equal(again.static[2].T_world_mesh, demo.static[2].T_world_mesh)
    bare = Cell("bare", np.zeros(3), np.ones(3))
    assert Cell.from_document(*bare.to_document()).to_document() == bare.to_document()


def test_version_distinguishes_cells(demo: Cell) -> None:
    assert demo.version == Cell.load(CELLS / "demo" / "cell.yaml").version
    moved = demo.with_object_pose("tray", from_xyz_rpy((0.5, -0.2, 0.0), (0.0, 0.0, 0.3)))
    assert moved.version != demo.version
    back = moved.with_object_pose("tray", demo.objects[0].T_world_mesh)
    assert back.version == demo.version
    other = dataclasses.replace(
        demo, static=(*demo.static[:2], dataclasses.replace(demo.static[2], mesh=box_mesh("s", (1, 1, 1))))
    )
    assert other.version != demo.version


def test_moving_an_object_makes_another_cell(demo: Cell) -> None:
    pose = from_xyz_rpy((0.5, -0.2, 0.0), (0.0, 0.0, 0.3))
    before = demo.objects[0].T_world_mesh.copy()
    moved = demo.with_object_pose("tray", pose)
    np.testing.assert_array_equal(moved.objects[0].T_world_mesh, pose)
    np.testing.assert_array_equal(demo.objects[0].T_world_mesh, before)
    assert moved.static is demo.static
    pose[0, 3] = 9.0
    assert moved.objects[0].T_world_mesh[0, 3] == 0.5
    with pytest.raises(InputError, match="object: expected one of tray, got table"):
        demo.with_object_pose("table", identity())
    with pytest.raises(InputError, match="tray T_world_mesh: expected a right-handed rotation"):
        demo.with_object_pose("tray", np.diag([1.0, 1.0, -1.0, 1.0]))


def test_nothing_in_a_cell_can_be_changed(demo: Cell) -> None:
    assert demo.robot is not None
    assert demo.board is not None
    arrays = (
        demo.box_min_m,
        demo.box_max_m,
        demo.static[0].T_world_mesh,
        demo.objects[0].mesh.vertices,
        demo.robot.T_world_base,
        demo.robot.links[0].mesh.faces,
        demo.board.T_world_board,
    )
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        demo.name = "other"  # type: ignore[misc]  # what must fail


def test_lattice_covers_the_box_and_has_a_limit(demo: Cell) -> None:
    lattice = demo.lattice(0.05)
    assert (lattice.origin_m, lattice.shape) == ((-1.5, -1.5, -0.75), (60, 60, 45))
    hall = Cell("hall", np.zeros(3), np.array([20.0, 20.0, 5.0]))
    with pytest.raises(InputError, match="expected at most 134217728, choose larger voxels or a smaller box"):
        hall.lattice(0.01)


def test_shapes_of_every_form(tmp_path: Path) -> None:
    trimesh.creation.box(extents=(100.0, 200.0, 300.0)).export(tmp_path / "part.stl")
    cell = Cell.load(
        written(
            tmp_path,
            "static:\n"
            "  - {name: part, mesh: part.stl, scale: 0.001, pose: {xyz: [0.5, 0, 0], rpy_deg: [0, 0, 90]}}\n"
            "  - {name: post, cylinder: {radius: 0.1, length: 1}, pose: {xyz: [0, 0, 0.5]}}\n"
            "objects: [{name: crate, box: [0.2, 0.4, 0.6]}]\n",
        )
    )
    assert world_bounds_m(cell.static[0]) == [pytest.approx([0.4, -0.05, -0.15]), pytest.approx([0.6, 0.05, 0.15])]
    assert world_bounds_m(cell.static[1]) == [
        pytest.approx([-0.1, -0.1, 0.0], abs=1e-6),
        pytest.approx([0.1, 0.1, 1.0], abs=1e-6),
    ]
    assert world_bounds_m(cell.objects[0]) == [pytest.approx([-0.1, -0.2, -0.3]), pytest.approx([0.1, 0.2, 0.3])]


def test_dh_robot_with_prismatic_joint_and_tool(tmp_path: Path) -> None:
    robot = Cell.load(
        written(
            tmp_path,
            "robot:\n"
            "  pose: {xyz: [1, 2, 3], rpy_deg: [0, 0, 90]}\n"
            "  dh:\n"
            "    base: {box: [0.1, 0.1, 0.1]}\n"
            "    joints:\n"
            "      - {theta_deg: 90, a_m: 0.5}\n"
            "      - {name: lift, kind: prismatic, d_m: 0.1, link: {box: [0.1, 0.1, 0.2], pose: {xyz: [0, 0, -0.1]}}}\n"
            "  tool: {cylinder: {radius: 0.02, length: 0.1}, pose: {xyz: [0, 0, 0.05]}}\n",
        )
    ).robot
    assert robot is not None
    assert robot.joint_names == ("joint_1", "lift")
    assert [link.name for link in robot.links] == ["base", "link_2", "tool"]
    np.testing.assert_allclose(robot.T_world_base, from_xyz_rpy((1, 2, 3), (0, 0, math.pi / 2)), atol=1e-12)
    np.testing.assert_allclose(
        robot.link_poses([0.0, 0.3])[1], from_xyz_rpy((0, 0.5, 0.4), (0, 0, math.pi / 2)), atol=1e-12
    )
    np.testing.assert_allclose(robot.links[1].mesh.bounds_m, [[-0.05, -0.05, -0.2], [0.05, 0.05, 0.0]], atol=1e-7)
    np.testing.assert_allclose(robot.links[2].mesh.bounds_m[1][2], 0.1, atol=1e-7)


def test_urdf_robot_with_every_key(tmp_path: Path) -> None:
    (tmp_path / "ros" / "my_arm" / "meshes").mkdir(parents=True)
    trimesh.creation.box(extents=(0.2, 0.2, 0.2)).export(tmp_path / "ros" / "my_arm" / "meshes" / "b.stl")
    shapes = (
        "<collision><geometry><mesh filename='package://arm_description/meshes/b.stl'/></geometry></collision>"
        "<visual><geometry><mesh filename='package://arm_description/meshes/b.stl' scale='2 2 2'/></geometry></visual>"
    )
    slide = (
        '<link name="c"><visual><geometry><sphere radius="0.1"/></geometry></visual></link>'
        '<joint name="slide" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/></joint>'
        '<link name="d"/><joint name="wrist" type="continuous"><parent link="c"/><child link="d"/></joint>'
    )
    (tmp_path / "r.urdf").write_text(URDF.format(shapes, TURN + slide))
    text = (
        "robot:\n"
        "  urdf: r.urdf\n"
        "  meshes: {}\n"
        "  joints: [wrist, j]\n"
        "  held_joints: {{slide: 0.3}}\n"
        "  packages: {{arm_description: ros/my_arm}}\n"
        "  tool: {{box: [0.1, 0.1, 0.1], pose: {{xyz: [0, 0, 0.05]}}}}\n"
    )
    visual = Cell.load(written(tmp_path, text.format("visual"))).robot
    collision = Cell.load(written(tmp_path, text.format("collision"))).robot
    assert visual is not None
    assert collision is not None
    assert visual.joint_names == ("wrist", "j")
    assert [link.name for link in visual.links] == ["b", "c", "tool"]
    assert [link.name for link in collision.links] == ["b", "tool"]
    np.testing.assert_allclose(visual.links[0].mesh.bounds_m[1], 0.2, atol=1e-7)
    np.testing.assert_allclose(collision.links[0].mesh.bounds_m[1], 0.1, atol=1e-7)
    np.testing.assert_allclose(visual.link_poses([0.0, 0.0])[1:, 2, 3], 0.3, atol=1e-12)
    np.testing.assert_allclose(visual.links[2].mesh.bounds_m[1][2], 0.1, atol=1e-7)


URDF = '<robot name="r"><link name="a"/><link name="b">{}</link>{}</robot>'
TURN = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
SHAPE = "<collision><geometry><box size='1 1 1'/></geometry></collision>"

BAD = {
    "missing stl": ("static: [{name: a, mesh: gone.stl}]\n", "static[0].mesh: expected a file at"),
    "missing object": ("objects: [{name: a, mesh: gone.stl}]\n", "objects[0].mesh: expected a file at"),
    "empty stl": (
        "static: [{name: a, mesh: empty.stl}]\n",
        "static[0].mesh: {folder}/empty.stl: expected an STL file of at least",
    ),
    "noise": ("static: [{name: a, mesh: noise.ply}]\n", "static[0].mesh: {folder}/noise.ply: expected a readable mesh"),
    "millimetres": ("static: [{name: a, mesh: mm.stl}]\n", "for a file in millimetres set scale 0.001"),
    "no urdf": ("robot: {urdf: gone.urdf}\n", "robot.urdf: expected a file at {folder}/gone.urdf, found none"),
    "bad urdf": ("robot: {urdf: empty.stl}\n", "robot: {folder}/empty.stl: expected a URDF file, got malformed XML"),
    "bare urdf": ("robot: {urdf: bare.urdf}\n", "robot: expected at least one link with a mesh, got none"),
    "joints": (
        "robot: {urdf: r.urdf, joints: [k]}\n",
        "robot: {folder}/r.urdf: expected actuated joints out of j, got k",
    ),
    "link mesh": (
        "robot: {urdf: r.urdf, link_meshes: {b: {mesh: gone.stl}}}\n",
        "robot.link_meshes.b.mesh: expected a file at",
    ),
    "link": ("robot: {urdf: r.urdf, link_meshes: {c: {box: [1, 1, 1]}}}\n", "expected links of a, b, got c"),
    "tool": ("robot: {urdf: r.urdf, tool: {mesh: gone.stl}}\n", "robot.tool.mesh: expected a file at"),
    "tool parent": (
        "robot: {urdf: r.urdf, tool: {box: [1, 1, 1], parent: hand}}\n",
        "robot: {folder}/r.urdf: expected a link to hold the tool, got hand",
    ),
    "dh mesh": (
        "robot: {dh: {joints: [{}, {link: {mesh: gone.stl}}]}}\n",
        "robot.dh.joints[1].link.mesh: expected a file at",
    ),
    "dh base": ("robot: {dh: {base: {mesh: gone.stl}, joints: [{}]}}\n", "robot.dh.base.mesh: expected a file"),
    "dh without meshes": ("robot: {dh: {joints: [{}]}}\n", "robot: expected at least one link with a mesh, got none"),
    "dh names": (
        "robot: {dh: {base: {box: [1, 1, 1]}, joints: [{name: a}, {name: a}]}}\n",
        "robot: robot: expected each joint once, got a more than once",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_a_cell_names_and_is_wrong_is_one_sentence(tmp_path: Path, case: str) -> None:
    text, words = BAD[case]
    (tmp_path / "empty.stl").touch()
    (tmp_path / "noise.ply").write_bytes(b"ply\n")
    trimesh.creation.box(extents=(3000.0, 100.0, 100.0)).export(tmp_path / "mm.stl")
    (tmp_path / "bare.urdf").write_text(URDF.format("", TURN))
    (tmp_path / "r.urdf").write_text(URDF.format(SHAPE, TURN))
    file = written(tmp_path, text)
    with pytest.raises(CellError) as caught:
        Cell.load(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert words.format(folder=tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, ConfigError)


def bad_documents(document: dict[str, Any]) -> list[tuple[object, str]]:
    def changed(**values: object) -> dict[str, Any]:
        return {**document, **values}

    body = document["static"][1]
    skewed = np.diag([2.0, 1.0, 1.0, 1.0]).tolist()
    return [
        (None, "cell document: "),
        (changed(more=1), "more"),
        ({key: value for key, value in document.items() if key != "static"}, "static"),
        (changed(box_max_m=[-1.5, 2, 2]), "expected box_max_m above box_min_m"),
        (changed(box_max_m=[math.inf, 2, 2]), "box_max_m"),
        (changed(static=[body, body]), "expected each name once among static and objects"),
        (changed(static=[{**body, "T_world_mesh": skewed}]), "table T_world_mesh: expected a right-handed rotation"),
        (changed(static=[{**body, "T_world_mesh": [[1], [2, 3]]}]), "table T_world_mesh: expected a 4x4 matrix"),
        (changed(static=[{**body, "mesh": "0" * 64}]), "mesh table: expected bytes with sha256 0000"),
        (changed(static=[body] * 1001), "static"),
        (changed(robot={"name": "r"}), "robot document: "),
        (changed(board={**document["board"], "columns": "many"}), "board document: columns"),
        (changed(board={**document["board"], "T_world_board": skewed}), "board document: T_world_board: expected"),
    ]


def test_bad_documents_are_refused_with_the_reason(demo: Cell) -> None:
    document, meshes = demo.to_document()
    for wrong, words in bad_documents(document):
        with pytest.raises(CellError) as caught:
            Cell.from_document(wrong, meshes)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)
    swapped = dict(zip(meshes, reversed(meshes.values()), strict=True))
    with pytest.raises(CellError, match=r"cell document: mesh \w+: expected bytes with sha256"):
        Cell.from_document(document, swapped)


def test_board_travels_by_itself(demo: Cell) -> None:
    assert demo.board is not None
    document = json.loads(json.dumps(demo.board.to_document()))
    assert Board.from_document(document).to_document() == demo.board.to_document()
    with pytest.raises(CellError, match="board document: kind"):
        Board.from_document({**document, "kind": "dots"})
