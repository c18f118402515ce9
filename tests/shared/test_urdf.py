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
    with pytest.raises(MeshError, match=r"nothing there: package://some_robot_wheel/meshes/part\.stl \(link base\)"):
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
        "joint j: origin xyz: expected 3 numbers, got '0 0 x'",
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
        "joint j: origin xyz: expected 3 numbers, got '0 0 nan'",
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
        "expected these mesh files, got nothing there: gone.stl (link a)",
    ),
    "no name of a mesh": (
        f"<robot name='r'>{link('a', '<collision><geometry><mesh/></geometry></collision>')}</robot>",
        "link a: expected a mesh with a filename, got none",
    ),
    "unknown shape": (
        f"<robot name='r'>{link('a', '<collision><geometry><cone/></geometry></collision>')}</robot>",
        "link a: expected a shape of mesh, box, cylinder, sphere, capsule, ellipsoid, got <cone>",
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


def shape(inside: str, tag: str = "collision") -> str:
    return f"<{tag}><geometry>{inside}</geometry></{tag}>"


@pytest.mark.parametrize("where", ["joint", "collision"])
@pytest.mark.parametrize("quaternion", ["0.6 0 0 0.8", "-0.6 0 0 -0.8", "0.6002 0 0 0.7999"])
def test_a_quaternion_turns_as_the_same_rpy_does(tmp_path: Path, where: str, quaternion: str) -> None:
    made = {}
    for name, rotation in (("q", f'quat_xyzw="{quaternion}"'), ("r", f'rpy="{2 * np.arcsin(0.6)} 0 0"')):
        origin = f'<origin xyz="1 2 3" {rotation}/>'
        in_link, in_joint = (origin, "") if where == "collision" else ("", origin)
        box = f'<collision>{in_link}<geometry><box size="0.1 0.2 0.3"/></geometry></collision>'
        model = read_urdf(
            urdf(tmp_path, link("a"), link("b", box), joint("j", "a", "b", in_joint), name=f"{name}.urdf")
        )
        made[name] = (model.joints[0].T_parent_joint, *model.meshes["b"].bounds_m)
    for quat, rpy in zip(made["q"], made["r"], strict=True):
        np.testing.assert_allclose(quat, rpy, atol=1e-3)


@pytest.mark.parametrize(
    ("inside", "size"),
    [
        ('<capsule radius="0.05" length="0.3"/>', (0.1, 0.1, 0.4)),
        ('<drake:capsule radius="0.05" length="0.3"/>', (0.1, 0.1, 0.4)),
        ('<capsule radius="0.05" length="0"/>', (0.1, 0.1, 0.1)),
        ('<ellipsoid size="0.1 0.2 0.3"/>', (0.1, 0.2, 0.3)),
        ('<drake:ellipsoid a="0.05" b="0.1" c="0.15"/>', (0.1, 0.2, 0.3)),
    ],
)
def test_shapes_of_newer_urdfs_are_read(tmp_path: Path, inside: str, size: tuple[float, ...]) -> None:
    mesh = read_urdf(urdf(tmp_path, link("a", shape(inside)))).meshes["a"]
    assert mesh.closed
    low, high = mesh.bounds_m
    np.testing.assert_allclose(high - low, size, atol=2e-3)
    np.testing.assert_allclose(high, -low, atol=1e-6)


XACRO = {
    "include": ('<xacro:include filename="x.xacro"/>', "robot r", "xacro:include"),
    "condition": (f'<xacro:if value="true">{link("c")}</xacro:if>', "robot r", "xacro:if"),
    "value": (link("c", shape('<box size="1 1 ${2*x}"/>')), "link c", "${2*x}"),
    "substitution": (link("c", PARTS.format(uri="$(find arm)/a.stl", scale="")), "link c", "$(find arm)"),
}


@pytest.mark.parametrize("case", XACRO)
def test_xacro_that_was_not_expanded_is_refused_by_name(tmp_path: Path, case: str) -> None:
    inside, where, what = XACRO[case]
    with pytest.raises(KinematicsError) as caught:
        read_urdf(urdf(tmp_path, link("a"), inside))
    for words in ("robot.urdf: " + where, what, "expand xacro first"):
        assert words in str(caught.value)


def test_an_expanded_file_may_declare_xacro(tmp_path: Path) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text('<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><!-- ${x} --><link name="a"/></robot>')
    assert read_urdf(file).links == ("a",)


def test_a_link_without_collision_is_filtered_by_its_visual_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    visual = shape('<box size="0.1 0.1 0.1"/>', "visual")
    both = shape('<box size="0.3 0.3 0.3"/>') + visual
    file = urdf(
        tmp_path,
        link("a", both),
        link("guide", visual),
        link("tool0"),
        joint("j", "a", "guide"),
        joint("k", "a", "tool0"),
    )
    model = read_urdf(file)
    assert list(model.meshes) == ["a", "guide"]
    np.testing.assert_allclose(model.meshes["a"].bounds_m[1], 0.15)
    (warning,) = model.warnings
    assert "guide" in warning
    assert "tool0" not in warning
    assert warning in caplog.text
    assert list(read_urdf(file, "collision").meshes) == ["a"]
    (warning,) = read_urdf(file, "collision").warnings
    assert warning == "links without a collision shape, which are reported as obstacles: guide"


def test_a_shape_of_no_size_is_passed_over_with_a_word(tmp_path: Path) -> None:
    zero, solid = shape('<sphere radius="0"/>'), shape('<sphere radius="0.1"/>')
    file = urdf(
        tmp_path,
        link("a", zero + solid),
        link("b", zero),
        link("c", zero + solid.replace("collision", "visual")),
        joint("ab", "a", "b"),
        joint("ac", "a", "c"),
    )
    model = read_urdf(file)
    assert list(model.meshes) == ["a", "c"]
    assert any("a (<sphere>), b (<sphere>), c (<sphere>)" in warning for warning in model.warnings)


@pytest.mark.parametrize("tag", ["collision", "visual"])
def test_a_link_whose_only_shape_is_empty_is_refused_by_name(tmp_path: Path, tag: str) -> None:
    file = urdf(tmp_path, link("a", shape("", tag)))
    with pytest.raises(KinematicsError, match="link a: expected a shape in its <geometry>, got none"):
        read_urdf(file)
    own = box_mesh("own", (1, 1, 1))
    assert read_urdf(file, replaced={"a": own}).meshes["a"] is own


MALFORMED = {
    "box of two": (link("a", shape('<box size="1 1"/>')), "link a: box size: expected 3 numbers, got '1 1'"),
    "negative": (link("a", shape('<box size="1 1 -1"/>')), "link a: box: expected sizes above 0"),
    "no radius": (link("a", shape("<sphere/>")), "link a: expected <sphere> with radius, got none"),
    "infinite": (link("a", shape('<sphere radius="inf"/>')), "link a: sphere radius: expected one number, got 'inf'"),
    "decimal comma": (link("a", shape('<sphere radius="0,1"/>')), "link a: sphere radius: expected one number"),
    "two shapes": (link("a", shape('<sphere radius="1"/><box size="1 1 1"/>')), "link a: expected one shape"),
    "no geometry": (link("a", "<collision/>"), "link a: expected a <geometry> in <collision>, got none"),
    "scale": (link("a", PARTS.format(uri="a.stl", scale=' scale="1 2"')), "link a: mesh scale: expected one number or"),
    "rpy and quaternion": (
        link("a", '<collision><origin rpy="0 0 0" quat_xyzw="0 0 0 1"/><geometry/></collision>'),
        "link a: origin: expected rpy or quat_xyzw, got both",
    ),
    "long quaternion": (
        link("a", '<collision><origin quat_xyzw="0 0 0 2"/><geometry/></collision>'),
        "link a: origin quat_xyzw: expected a quaternion of length 1, got one of 2",
    ),
    "no name": ("<link/>", "expected every link to have a name"),
    "multiplier": (
        link("a") + link("b") + joint("j", "a", "b", '<mimic joint="k" multiplier="x"/>'),
        "joint j: mimic multiplier: expected one number, got 'x'",
    ),
    "two origins": (
        link("a") + link("b") + joint("j", "a", "b", "<origin/><origin/>"),
        "joint j: expected one <origin>, got 2",
    ),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_attribute_is_named_with_its_link_or_joint(tmp_path: Path, case: str) -> None:
    inside, words = MALFORMED[case]
    part(tmp_path, "a.stl")
    with pytest.raises((KinematicsError, MeshError)) as caught:
        read_urdf(urdf(tmp_path, inside))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_all_missing_meshes_are_named_at_once(tmp_path: Path) -> None:
    inside = "".join(link(f"l{i}", PARTS.format(uri=f"package://arm/{i}.stl", scale="")) for i in range(12))
    joints = "".join(joint(f"j{i}", "l0", f"l{i}") for i in range(1, 12))
    with pytest.raises(MeshError, match=r"package://arm/0\.stl \(link l0\), .*package://arm/9.*and 2 more.*packages"):
        read_urdf(urdf(tmp_path, inside, joints))


def test_file_names_of_another_computer_are_found_by_their_package(tmp_path: Path) -> None:
    part(tmp_path / "here" / "meshes")
    uri = "file:///opt/ros/humble/share/arm_description/meshes/part.stl"
    file = urdf(tmp_path / "robot", link("base", PARTS.format(uri=uri, scale="")))
    model = read_urdf(file, packages={"arm_description": tmp_path / "here", "gripper": tmp_path})
    assert list(model.meshes) == ["base"]
    assert model.warnings == ("names under packages that no mesh of the file uses: gripper",)
