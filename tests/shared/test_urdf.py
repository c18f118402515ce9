# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shared.errors import KinematicsError, MeshError
from shared.meshes import box_mesh
from shared.urdf import read_urdf

PARTS = '<collision><geometry><mesh filename="{uri}"{scale}/></geometry></collision>'


def urdf(folder: Path, *content: str, name: str = "robot.urdf") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / name
    file.write_text(f'<robot name="r">{"".join(content)}</robot>')
    return file


def link(name: str, inside: str = "") -> str:
    return f'<link name="{name}">{inside}</link>'


def joint(name: str, parent: str, child: str, inside: str = "", kind: str = "revolute") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def part(folder: Path, name: str = "part.stl", size: float = 1.0) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(extents=(size, size, size)).export(folder / name)
    return folder / name


def test_several_shapes_of_a_link_become_one_mesh_in_its_frame(tmp_path: Path) -> None:
    shapes = (
        '<collision><origin xyz="1 0 0" rpy="0 0 1.5707963267948966"/>'
        '<geometry><box size="0.2 0.4 0.6"/></geometry></collision>'
        '<collision><origin xyz="-1 0 0"/><geometry><sphere radius="0.1"/></geometry></collision>'
        '<collision><geometry><cylinder radius="0.1" length="2"/></geometry></collision>'
        '<visual><geometry><box size="9 9 9"/></geometry></visual>'
    )
    file = urdf(tmp_path, link("base", shapes), link("bare"), joint("j", "base", "bare"))
    model = read_urdf(file)
    assert list(model.meshes) == ["base"]
    assert model.meshes["base"].closed
    np.testing.assert_allclose(model.meshes["base"].bounds_m, [[-1.1, -0.1, -1.0], [1.2, 0.1, 1.0]], atol=1e-6)
    np.testing.assert_allclose(read_urdf(file, "visual").meshes["base"].bounds_m[1], [4.5, 4.5, 4.5])
    own = box_mesh("own", (1, 1, 1))
    assert read_urdf(file, replaced={"bare": own}).meshes["bare"] is own


@pytest.mark.parametrize(
    "uri",
    ["meshes/part.stl", "package://my_robot/meshes/part.stl", "package://outer/my_robot/meshes/part.stl", "file://{}"],
)
def test_mesh_files_are_found(tmp_path: Path, uri: str) -> None:
    folder = tmp_path / "outer" / "my_robot"
    file = part(folder / "meshes")
    place = folder if uri.startswith("meshes") else folder / "urdf" / "deep"
    model = read_urdf(urdf(place, link("base", PARTS.format(uri=uri.format(file), scale=' scale="2 1 -1"'))))
    mesh = model.meshes["base"]
    assert mesh.closed
    np.testing.assert_allclose(mesh.bounds_m[1], [1.0, 0.5, 0.5])


def test_packages_are_given_or_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part(tmp_path / "elsewhere" / "meshes")
    file = urdf(
        tmp_path / "robot", link("base", PARTS.format(uri="package://some_robot_wheel/meshes/part.stl", scale=""))
    )
    with pytest.raises(
        KinematicsError, match=r"link base: expected to find package://some_robot_wheel/meshes/part\.stl"
    ):
        read_urdf(file)
    assert read_urdf(file, packages={"some_robot_wheel": tmp_path / "elsewhere"}).meshes
    package = tmp_path / "site" / "some_robot_wheel"
    part(package / "meshes")
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert read_urdf(file).meshes
    assert "some_robot_wheel" not in sys.modules


def test_order_is_depth_first_for_any_order_of_the_file(tmp_path: Path) -> None:
    file = urdf(
        tmp_path,
        *(link(name) for name in "edcba"),
        joint("dc", "d", "c"),
        joint("ab", "a", "b"),
        joint("ad", "a", "d"),
        joint("be", "b", "e"),
    )
    model = read_urdf(file)
    assert (model.root, [each.name for each in model.joints]) == ("a", ["ab", "be", "ad", "dc"])


def test_foreign_prefixes_and_comments_are_ignored(tmp_path: Path) -> None:
    file = urdf(
        tmp_path,
        "<!-- a -->",
        link("a"),
        link("b"),
        "<drake:thing><link name='no'/></drake:thing>",
        joint("j", "a", "b", '<axis xyz="0 0 3"/><limit drake:acceleration="2" lower="0" upper="1"/> # note'),
    )
    model = read_urdf(file)
    assert model.links == ("a", "b")
    assert model.joints[0].axis == (0.0, 0.0, 1.0)


TWO = link("a") + link("b")
BAD = {
    "cut off": (
        "<robot name='r'><link name='a'/>",
        "expected a URDF file, got malformed XML: no element found: line 1",
    ),
    "empty": ("", "expected a URDF file, got malformed XML"),
    "other": ("<sdf/>", "expected <robot> as the outermost element, got <sdf>"),
    "no links": ("<robot name='r'/>", "expected a robot with links, got none"),
    "number": (
        f"<robot name='r'>{TWO}{joint('j', 'a', 'b', '<origin xyz=' + chr(34) + '0 0 x' + chr(34) + '/>')}</robot>",
        "expected a URDF file, got ValueError",
    ),
    "no child": (f"<robot name='r'>{TWO}{joint('j', 'a', 'c')}</robot>", "joint j: expected a child that is a link"),
    "floating": (
        f"<robot name='r'>{TWO}{joint('j', 'a', 'b', kind='floating')}</robot>",
        "joint j: expected a type of revolute, continuous, prismatic, fixed, got floating",
    ),
    "axis": (
        f"<robot name='r'>{TWO}{joint('j', 'a', 'b', '<axis xyz=' + chr(34) + '0 0 0' + chr(34) + '/>')}</robot>",
        "joint j: expected an axis of three numbers, not all zero",
    ),
    "nan": (
        f"<robot name='r'>{TWO}{joint('j', 'a', 'b', '<origin xyz=' + chr(34) + '0 0 nan' + chr(34) + '/>')}</robot>",
        "joint j: origin: expected finite numbers",
    ),
    "two roots": (f"<robot name='r'>{TWO}</robot>", "expected one link that is no joint's child, got a, b"),
    "two parents": (
        f"<robot name='r'>{TWO}{link('c')}{joint('j', 'a', 'c')}{joint('k', 'b', 'c')}</robot>",
        "expected one joint to hold link c, got several",
    ),
    "ring": (
        f"<robot name='r'>{TWO}{link('c')}{joint('j', 'a', 'b')}{joint('k', 'b', 'a')}</robot>",
        "expected all joints below c, got a ring of j, k",
    ),
    "twice": (
        f"<robot name='r'>{TWO}{link('c')}{joint('j', 'a', 'b')}{joint('j', 'a', 'c')}</robot>",
        "expected each joint once, got j more than once",
    ),
    "no mesh file": (
        f"<robot name='r'>{link('a', PARTS.format(uri='gone.stl', scale=''))}</robot>",
        "link a: ",
    ),
    "no name of a mesh": (
        f"<robot name='r'>{link('a', '<collision><geometry><mesh/></geometry></collision>')}</robot>",
        "link a: expected a mesh with a filename, got none",
    ),
    "unknown shape": (
        f"<robot name='r'>{link('a', '<collision><geometry><cone/></geometry></collision>')}</robot>",
        "expected a URDF file, got ValueError: Unknown tag: cone",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_one_sentence_that_names_them(tmp_path: Path, case: str) -> None:
    text, words = BAD[case]
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    with pytest.raises((KinematicsError, MeshError)) as caught:
        read_urdf(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_and_unknown_link_are_named(tmp_path: Path) -> None:
    with pytest.raises(KinematicsError, match=r"gone\.urdf: expected a readable URDF file, got No such file"):
        read_urdf(tmp_path / "gone.urdf")
    file = urdf(tmp_path, link("a"))
    with pytest.raises(KinematicsError, match="expected links of a, got elbow"):
        read_urdf(file, replaced={"elbow": box_mesh("e", (1, 1, 1))})


def test_a_missing_parser_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yourdfpy", None)
    with pytest.raises(KinematicsError, match="expected yourdfpy to read a URDF, got no such package installed"):
        read_urdf(urdf(tmp_path, link("a")))
