# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shared.clock import NS_PER_MS, stage_ns
from shared.errors import InputError, KinematicsError, MeshError
from shared.joint_table import BASE, Attachment, DHJoint, Motion
from shared.kinematics import Robot
from shared.meshes import TriangleMesh, box_mesh
from shared.transforms import apply, from_xyz_rpy, identity, inverse

UR3_ROWS = (  # d, a, alpha as Universal Robots publishes them
    (0.1519, 0.0, math.pi / 2),
    (0.0, -0.24365, 0.0),
    (0.0, -0.21325, 0.0),
    (0.11235, 0.0, math.pi / 2),
    (0.08535, 0.0, -math.pi / 2),
    (0.0819, 0.0, 0.0),
)

UR3_JOINTS = (  # joint, parent, child, xyz, rpy, axis
    ("shoulder_pan_joint", "base_link", "shoulder_link", "0 0 0.1519", "0 0 0", "0 0 1"),
    ("shoulder_lift_joint", "shoulder_link", "upper_arm_link", "0 0.1198 0", f"0 {math.pi / 2} 0", "0 1 0"),
    ("elbow_joint", "upper_arm_link", "forearm_link", "0 -0.0925 0.24365", "0 0 0", "0 1 0"),
    ("wrist_1_joint", "forearm_link", "wrist_1_link", "0 0 0.21325", f"0 {math.pi / 2} 0", "0 1 0"),
    ("wrist_2_joint", "wrist_1_link", "wrist_2_link", "0 0.08505 0", "0 0 0", "0 0 1"),
    ("wrist_3_joint", "wrist_2_link", "wrist_3_link", "0 0 0.08535", "0 0 0", "0 1 0"),
)

MIXED = """<robot name="mixed">
  <link name="rail"/><link name="carriage"><collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
  <link name="post"><collision><origin xyz="0 0 0.25"/><geometry><cylinder radius="0.05" length="0.5"/></geometry>
    </collision></link>
  <link name="arm"><collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.05 0.05"/></geometry></collision></link>
  <link name="finger_left"><collision><geometry><box size="0.1 0.01 0.02"/></geometry></collision></link>
  <link name="finger_right"><collision><geometry><sphere radius="0.02"/></geometry></collision></link>
  <joint name="finger_right_joint" type="prismatic"><parent link="arm"/><child link="finger_right"/>
    <origin xyz="0.4 -0.02 0" rpy="0 0 3.1"/><axis xyz="0 2 0"/>
    <mimic joint="finger_joint" multiplier="-0.5" offset="0.01"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="carriage"/>
    <origin xyz="0 0 0.1" rpy="0.1 0 0"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="mount" type="fixed"><parent link="carriage"/><child link="post"/>
    <origin xyz="0 0 0.05" rpy="0 0 0.3"/></joint>
  <joint name="turn" type="continuous"><parent link="post"/><child link="arm"/><origin xyz="0 0 0.5"/>
    <axis xyz="0 1 1"/></joint>
  <joint name="finger_joint" type="revolute"><parent link="arm"/><child link="finger_left"/><origin xyz="0.4 0.02 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>
"""


def ur3_urdf() -> str:
    links = ["base_link", "base", "ee_link", "tool0", *(joint[2] for joint in UR3_JOINTS)]
    lines = [f'<link name="{link}"/>' for link in links]
    for name, parent, child, xyz, rpy, axis in UR3_JOINTS:
        lines.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
            '<limit lower="-6.28" upper="6.28" effort="1" velocity="1"/></joint>'
        )
    for name, parent, child, xyz, rpy in (
        ("base_fixed_joint", "base_link", "base", "0 0 0", f"0 0 {-math.pi}"),
        ("ee_fixed_joint", "wrist_3_link", "ee_link", "0 0.0819 0", f"0 0 {math.pi / 2}"),
        ("tool0_fixed_joint", "wrist_3_link", "tool0", "0 0.0819 0", f"{-math.pi / 2} 0 0"),
    ):
        lines.append(
            f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/></joint>'
        )
    return f'<robot name="ur3">{"".join(lines)}</robot>'


def ur3_dh(meshes: bool = False, tool: TriangleMesh | None = None) -> Robot:
    rows = [DHJoint(joint[0], *row) for joint, row in zip(UR3_JOINTS, UR3_ROWS, strict=True)]
    links = [box_mesh(f"m{index}", (0.1, 0.08, 0.06 + 0.01 * index)) if meshes else None for index in range(7)]
    return Robot.from_dh(rows, links, tool, "ur3")


def urdf_file(folder: Path, text: str) -> Path:
    file = folder / "robot.urdf"
    file.write_text(text)
    return file


def airo_ur3e() -> Path:
    return Path(str(metadata.distribution("airo-models").locate_file("airo_models/arms/ur3e/ur3e.urdf")))


def slow_dh_poses(rows: list[DHJoint], positions: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The paper's Algorithm 5 element by element: poses of link 0 to n."""
    poses = [np.eye(4)]
    for row, position in zip(rows, positions, strict=True):
        theta = row.theta_rad + (position if row.kind == "revolute" else 0.0)
        d = row.d_m + (position if row.kind == "prismatic" else 0.0)
        ct, st_, ca, sa = math.cos(theta), math.sin(theta), math.cos(row.alpha_rad), math.sin(row.alpha_rad)
        element = [
            [ct, -st_ * ca, st_ * sa, row.a_m * ct],
            [st_, ct * ca, -ct * sa, row.a_m * st_],
            [0.0, sa, ca, d],
            [0.0, 0.0, 0.0, 1.0],
        ]
        product = np.zeros((4, 4))
        for i in range(4):
            for j in range(4):
                product[i, j] = sum(poses[-1][i, k] * element[k][j] for k in range(4))
        poses.append(product)
    return poses


def dh_rows() -> st.SearchStrategy[list[DHJoint]]:
    length = st.floats(-1.0, 1.0)
    angle = st.floats(-math.pi, math.pi)
    kinds: list[Literal["revolute", "prismatic"]] = ["revolute", "prismatic"]
    kind = st.sampled_from(kinds)
    row = st.tuples(length, length, angle, angle, kind)
    return st.lists(row, min_size=1, max_size=7).map(
        lambda found: [DHJoint(f"j{index}", *values) for index, values in enumerate(found)]
    )


def test_published_dh_and_urdf_of_a_ur3_agree(tmp_path: Path) -> None:
    dh = ur3_dh()
    urdf = Robot.from_urdf(urdf_file(tmp_path, ur3_urdf()))
    assert urdf.joint_names == dh.joint_names
    rng = np.random.default_rng(1)
    for positions in (np.zeros(6), *rng.uniform(-math.pi, math.pi, (50, 6))):
        # Universal Robots' own base frame is the URDF's `base`, half a turn from `base_link`.
        T_base_link = inverse(urdf.frame_pose("base", positions))
        np.testing.assert_allclose(
            T_base_link @ urdf.frame_pose("tool0", positions), dh.frame_pose("link_6", positions), atol=2e-4
        )
        for index, joint in enumerate(UR3_JOINTS):
            T_urdf = T_base_link @ urdf.frame_pose(joint[2], positions)
            T_dh = dh.frame_pose("base" if index == 0 else f"link_{index}", positions)
            axis = T_urdf[:3, :3] @ np.array([float(value) for value in joint[5].split()])
            np.testing.assert_allclose(axis, T_dh[:3, 2], atol=1e-6)
            # Frames may sit anywhere along an axis; the axes are the same lines.
            between = T_urdf[:3, 3] - T_dh[:3, 3]
            assert np.linalg.norm(np.cross(between, axis)) < 2e-4


def test_dh_and_urdf_of_example_robot_data_agree() -> None:
    try:
        distribution = metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        pytest.skip("example-robot-data is not installed (431 MB, part of the bench extra)")
    folder = "cmeel.prefix/share/example-robot-data/robots/ur_description/urdf/ur3_robot.urdf"
    urdf = Robot.from_urdf(Path(str(distribution.locate_file(folder))))
    dh = ur3_dh()
    for positions in np.random.default_rng(2).uniform(-math.pi, math.pi, (20, 6)):
        T_base_tool = inverse(urdf.frame_pose("base", positions)) @ urdf.frame_pose("tool0", positions)
        np.testing.assert_allclose(T_base_tool, dh.frame_pose("link_6", positions), atol=2e-4)
    assert [link.name for link in urdf.links if not link.moving] == ["base_link"]
    assert [link.name for link in urdf.links][-2:] == ["wrist_3_link", "ee_link"]


@given(dh_rows(), st.randoms(use_true_random=False))
def test_dh_robot_equals_its_slow_twin(rows: list[DHJoint], random: Any) -> None:
    meshes = [box_mesh(f"m{index}", (0.1, 0.1, 0.1)) for index in range(len(rows) + 1)]
    robot = Robot.from_dh(rows, meshes, box_mesh("t", (0.1, 0.1, 0.1)))
    positions = np.array([random.uniform(-3.0, 3.0) for _ in rows])
    expected = slow_dh_poses(rows, positions)
    np.testing.assert_allclose(robot.link_poses(positions), [*expected, expected[-1]], atol=1e-12)
    assert [link.name for link in robot.links] == ["base", *(f"link_{i + 1}" for i in range(len(rows))), "tool"]
    assert [link.moving for link in robot.links] == [False] + [True] * (len(rows) + 1)
    assert [link.index for link in robot.links] == list(range(len(rows) + 2))


def test_urdf_robot_equals_yourdfpy_on_ur3e() -> None:
    yourdfpy = pytest.importorskip("yourdfpy")
    file = airo_ur3e()
    robot = Robot.from_urdf(file)
    twin = yourdfpy.URDF.load(str(file), load_meshes=False)
    assert list(robot.joint_names) == twin.actuated_joint_names
    for positions in np.random.default_rng(3).uniform(-2 * math.pi, 2 * math.pi, (20, 6)):
        twin.update_cfg(positions)
        for frame in robot.frame_names:
            np.testing.assert_allclose(
                robot.frame_pose(frame, positions), twin.get_transform(frame, "base_link"), atol=1e-9
            )


def test_prismatic_fixed_and_mimic_joints_equal_yourdfpy(tmp_path: Path) -> None:
    yourdfpy = pytest.importorskip("yourdfpy")
    file = urdf_file(tmp_path, MIXED)
    robot = Robot.from_urdf(file, joints=["turn", "finger_joint", "slide"])
    twin = yourdfpy.URDF.load(str(file), load_meshes=False)
    # yourdfpy moves a prismatic joint by the length of its axis too, which the file gives as 2.
    twin.joint_map["finger_right_joint"].axis = np.array([0.0, 1.0, 0.0])
    # ... and turns about the normalised axis.
    for turn, finger, slide in np.random.default_rng(4).uniform(-1.0, 1.0, (20, 3)):
        twin.update_cfg({"turn": turn, "finger_joint": finger, "slide": slide})
        for frame in robot.frame_names:
            np.testing.assert_allclose(
                robot.frame_pose(frame, [turn, finger, slide]), twin.get_transform(frame, "rail"), atol=1e-9
            )
    assert {link.name: link.moving for link in robot.links} == {
        "carriage": True,
        "post": True,
        "arm": True,
        "finger_left": True,
        "finger_right": True,
    }


def test_joints_come_in_the_order_of_the_chain(tmp_path: Path) -> None:
    assert Robot.from_urdf(urdf_file(tmp_path, MIXED)).joint_names == ("slide", "turn", "finger_joint")


def test_held_joints_and_their_mimic_joints_do_not_move(tmp_path: Path) -> None:
    file = urdf_file(tmp_path, MIXED)
    full = Robot.from_urdf(file)
    held = Robot.from_urdf(file, held_joints={"slide": 0.3, "finger_joint": -0.2})
    assert held.joint_names == ("turn",)
    np.testing.assert_allclose(held.link_poses([0.7]), full.link_poses([0.3, 0.7, -0.2]), atol=1e-12)
    assert [link.moving for link in held.links] == [False, False, True, True, True]


def test_tool_is_on_the_last_link_or_the_named_parent(tmp_path: Path) -> None:
    tool = box_mesh("gripper", (0.1, 0.1, 0.1))
    file = urdf_file(tmp_path, MIXED)
    with pytest.raises(
        KinematicsError, match="expected the tool's parent to be named, got several: finger_left, finger"
    ):
        Robot.from_urdf(file, tool=tool)
    with pytest.raises(KinematicsError, match="expected a link to hold the tool, got hand"):
        Robot.from_urdf(file, tool=tool, tool_parent="hand")
    robot = Robot.from_urdf(file, tool=tool, tool_parent="arm")
    poses = dict(zip((link.name for link in robot.links), robot.link_poses([0.1, 0.2, 0.3]), strict=True))
    np.testing.assert_array_equal(poses["tool"], poses["arm"])
    fork = ur3_urdf().replace('<link name="ee_link"/>', "").split('<joint name="ee_fixed_joint"')
    serial = Robot.from_urdf(urdf_file(tmp_path, fork[0] + fork[1].split("</joint>", 1)[1]), tool=tool)
    np.testing.assert_array_equal(serial.link_poses(np.ones(6))[0], serial.frame_pose("tool0", np.ones(6)))


def test_tool_may_be_on_a_link_named_tool(tmp_path: Path) -> None:
    text = ur3_urdf().replace("tool0", "tool")
    robot = Robot.from_urdf(urdf_file(tmp_path, text), tool=box_mesh("t", (1, 1, 1)), tool_parent="tool")
    assert [link.name for link in robot.links] == ["mounted_tool"]
    np.testing.assert_array_equal(robot.link_poses(np.ones(6))[0], robot.frame_pose("tool", np.ones(6)))


def test_longest_chain_counts_moving_joints_only(tmp_path: Path) -> None:
    joints = (("continuous", "a", "hand"), ("fixed", "a", "b"), ("fixed", "b", "c"), ("fixed", "c", "camera"))
    text = "".join(f'<link name="{link}"/>' for link in ("a", "b", "c", "hand", "camera"))
    for kind, parent, child in joints:
        text += f'<joint name="{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/></joint>'
    robot = Robot.from_urdf(urdf_file(tmp_path, f'<robot name="r">{text}</robot>'), tool=box_mesh("t", (1, 1, 1)))
    np.testing.assert_allclose(robot.link_poses([0.5])[0], robot.frame_pose("hand", [0.5]))
    assert robot.links[0].moving


def test_ur3e_links() -> None:
    robot = Robot.from_urdf(airo_ur3e())
    assert [link.name for link in robot.links] == [
        "base_link_inertia",
        "shoulder_link",
        "upper_arm_link",
        "forearm_link",
        "wrist_1_link",
        "wrist_2_link",
        "wrist_3_link",
    ]
    assert [link.moving for link in robot.links] == [False] + [True] * 6
    assert all(link.mesh.closed for link in robot.links)
    # Four cylinders of the upper arm as one mesh in the link's frame.
    assert robot.links[2].mesh.bounds_m[0][0] < -0.25


def test_link_meshes_of_the_real_robot(data_dir: Path) -> None:
    robot = Robot.from_urdf(data_dir / "xarm7_realsense" / "robot" / "xarm7.urdf")
    assert robot.joint_names == tuple(f"joint{index}" for index in range(1, 8))
    assert [len(link.mesh.faces) for link in robot.links][:2] == [6094, 3682]
    assert not robot.links[0].moving


def test_displacement_is_a_tight_bound() -> None:
    robot = ur3_dh(meshes=True, tool=box_mesh("t", (0.1, 0.1, 0.3)))
    rng = np.random.default_rng(5)
    for uncertainty in (0.001, 0.05, 2.0):
        positions = rng.uniform(-math.pi, math.pi, 6)
        bound = robot.displacement_m(uncertainty, positions)
        before = robot.link_poses(positions)
        worst = np.zeros(len(robot.links))
        for signs in rng.choice([-1.0, 1.0], (400, 6)):
            for size in (1.0, rng.uniform()):
                after = robot.link_poses(positions + signs * uncertainty * size)
                for link, one, other in zip(robot.links, before, after, strict=True):
                    points = link.mesh.vertices.astype(np.float64)
                    moved = np.linalg.norm(apply(one, points) - apply(other, points), axis=1).max()
                    worst[link.index] = max(worst[link.index], moved)
        assert (worst <= bound + 1e-9).all()
        if uncertainty < 1.0:
            # All joints at their worst together is seldom reached; a bound of twice that would pad for nothing.
            assert (bound[1:] < 2.0 * worst[1:]).all()
    assert bound[0] == 0.0


def test_displacement_of_prismatic_and_mimic_joints_is_exact(tmp_path: Path) -> None:
    robot = Robot.from_urdf(urdf_file(tmp_path, MIXED))
    names = [link.name for link in robot.links]
    still = dict(zip(names, robot.displacement_m([0.02, 0.0, 0.0], [0.1, 0.2, 0.3]), strict=True))
    assert still == pytest.approx(dict.fromkeys(names, 0.02))
    finger = dict(zip(names, robot.displacement_m([0.0, 0.0, 0.1], [0.1, 0.2, 0.3]), strict=True))
    assert finger["arm"] == 0.0
    assert finger["finger_right"] == pytest.approx(0.05)
    # A box of 100 x 10 mm turned about its middle by 0.1 rad: the chord at half its diagonal.
    assert finger["finger_left"] == pytest.approx(2.0 * math.sin(0.05) * math.hypot(0.05, 0.005), rel=1e-6)


def test_errors_of_joints_name_the_expected_joints() -> None:
    robot = ur3_dh(meshes=True)
    names = ", ".join(joint[0] for joint in UR3_JOINTS)
    bad: tuple[Any, ...] = (
        [0.0] * 5,
        0.0,
        [[0.0] * 6],
        [0, 0, 0, 0, 0, math.nan],
        [math.inf] * 6,
        "abc",
        None,
        ["x"] * 6,
        [[0], [0, 1]],
    )
    for joints in bad:
        with pytest.raises(InputError) as caught:
            robot.link_poses(joints)
        assert f"joints: expected 6 finite positions ({names}), got " in str(caught.value)
        with pytest.raises(InputError):
            robot.displacement_m(0.01, joints)
    for uncertainty in (-0.1, math.nan, math.inf, [0.1] * 5):
        with pytest.raises(InputError, match="joint_uncertainty_rad: expected"):
            robot.displacement_m(uncertainty, [0.0] * 6)
    with pytest.raises(InputError, match="frame: expected one of base, link_1"):
        robot.frame_pose("elbow", [0.0] * 6)


@settings(max_examples=25)
@given(st.lists(st.floats(-7.0, 7.0), min_size=3, max_size=3))
def test_document_round_trip_through_json(tmp_path_factory: pytest.TempPathFactory, values: list[float]) -> None:
    file = urdf_file(tmp_path_factory.getbasetemp(), MIXED)
    robot = Robot.from_urdf(file, T_world_base=from_xyz_rpy((1, 2, 3), (0.1, 0.2, 0.3)))
    document, meshes = robot.to_document()
    again = Robot.from_document(json.loads(json.dumps(document)), meshes)
    np.testing.assert_array_equal(again.link_poses(values), robot.link_poses(values))
    np.testing.assert_array_equal(again.displacement_m(0.1, values), robot.displacement_m(0.1, values))
    np.testing.assert_array_equal(again.T_world_base, robot.T_world_base)
    assert again.to_document() == (document, meshes)
    assert again.joint_names == robot.joint_names
    assert [link.mesh.sha256 for link in again.links] == [link.mesh.sha256 for link in robot.links]


def test_bad_documents_are_refused() -> None:
    document, meshes = ur3_dh(meshes=True).to_document()

    def changed(**values: object) -> dict[str, Any]:
        return {**document, **values}

    motion = document["motions"][1]
    frame = document["frames"][1]
    bad: list[tuple[object, str]] = [
        (None, "robot document: "),
        ([], "robot document: "),
        (changed(extra=1), "extra"),
        (changed(motions=[{**motion, "parent": 3}]), "expected joint 0 after its parent, got parent 3"),
        (changed(motions=[{**motion, "parent": -2}]), "expected joint 0 after its parent, got parent -2"),
        (changed(motions=[{**motion, "parent": -1, "dof": 6}]), "expected a dof below 6, got 6"),
        (changed(motions=[{**motion, "parent": -1, "axis": [0, 0, 2]}]), "expected a unit axis in joint 0"),
        (changed(motions=[{**motion, "offset": math.nan}]), "offset"),
        (changed(motions=[{**motion, "kind": "planar"}]), "kind"),
        (changed(motions=[motion] * 129), "motions"),
        (changed(frames=[{**frame, "body": 6}]), "expected link link_1 on a body below 6, got 6"),
        (changed(frames=[frame, frame]), "expected each link once, got link_1 more than once"),
        (changed(frames=[{**frame, "T_body_frame": [[1, 2], [3]]}]), "T_body_frame: expected a 4x4 matrix"),
        (changed(T_world_base=(2 * np.eye(4)).tolist()), "T_world_base: expected"),
        (changed(joint_names=[*document["joint_names"], "more"]), "expected each joint to move something, got more"),
    ]
    for wrong, words in bad:
        with pytest.raises(KinematicsError) as caught:
            Robot.from_document(wrong, meshes)
        assert words in str(caught.value)
    with pytest.raises(MeshError, match="mesh base: expected bytes with sha256"):
        Robot.from_document(document, {})


def test_inconsistent_tables_and_rows_are_refused() -> None:
    motion = Motion("revolute", BASE, identity(), (0.0, 0.0, 1.0), 0)
    with pytest.raises(KinematicsError, match="r: expected each joint once, got a more than once"):
        Robot("r", ["a", "a"], [motion, Motion("revolute", 0, identity(), (0.0, 0.0, 1.0), 1)], [])
    with pytest.raises(KinematicsError, match="r: expected a finite origin of joint 0"):
        Robot("r", ["a"], [Motion("revolute", BASE, np.full((4, 4), np.nan), (0.0, 0.0, 1.0), 0)], [])
    with pytest.raises(KinematicsError, match="r: expected a finite frame of link l"):
        Robot("r", ["a"], [motion], [Attachment("l", 0, np.full((4, 4), np.inf))])
    with pytest.raises(KinematicsError, match=r"ur: expected 3 link meshes \(base and one a joint\), got 2"):
        Robot.from_dh([DHJoint("a"), DHJoint("b")], [None, None], name="ur")
    with pytest.raises(KinematicsError, match="expected finite numbers in joint 0"):
        Robot.from_dh([DHJoint("a", theta_rad=math.nan)], [None, None])
    with pytest.raises(KinematicsError, match="expected at most 128 moving joints, got 129"):
        Robot.from_dh([DHJoint(f"j{index}") for index in range(129)], [None] * 130)


def test_inconsistency_found_after_reading_names_the_file(tmp_path: Path) -> None:
    links = "".join(f'<link name="l{index}"/>' for index in range(130))
    joints = "".join(
        f'<joint name="j{index}" type="continuous"><parent link="l{index}"/><child link="l{index + 1}"/></joint>'
        for index in range(129)
    )
    file = urdf_file(tmp_path, f'<robot name="snake">{links}{joints}</robot>')
    with pytest.raises(KinematicsError) as caught:
        Robot.from_urdf(file)
    assert str(caught.value) == f"{file}: snake: expected at most 128 moving joints, got 129"


def test_unknown_and_missing_joints_are_named(tmp_path: Path) -> None:
    file = urdf_file(tmp_path, MIXED)
    free = "slide, turn, finger_joint"
    with pytest.raises(KinematicsError, match=f"expected actuated joints out of {free}, got finger_right_joint"):
        Robot.from_urdf(file, joints=["slide", "turn", "finger_joint", "finger_right_joint"])
    with pytest.raises(KinematicsError, match=f"expected actuated joints out of {free}, got mount"):
        Robot.from_urdf(file, held_joints={"mount": 0.0})
    with pytest.raises(KinematicsError, match="to be listed or held, got neither for turn, finger_joint"):
        Robot.from_urdf(file, joints=["slide"])
    with pytest.raises(KinematicsError, match="expected joints either listed or held, got turn in both"):
        Robot.from_urdf(file, joints=["slide", "turn"], held_joints={"turn": 0.0, "finger_joint": 0.0})
    with pytest.raises(KinematicsError, match="expected each joint once, got turn more than once"):
        Robot.from_urdf(file, joints=["slide", "turn", "turn", "finger_joint"])
    file.write_text(MIXED.replace('mimic joint="finger_joint"', 'mimic joint="finger_right_joint"'))
    with pytest.raises(
        KinematicsError, match="expected joint finger_right_joint to mimic another joint, got finger_right"
    ):
        Robot.from_urdf(file)


def test_robot_without_joints() -> None:
    robot = Robot(
        "post", [], [], [Attachment("post", BASE, from_xyz_rpy((0, 0, 1), (0, 0, 0)), box_mesh("p", (1, 1, 1)))]
    )
    assert robot.joint_count == 0
    assert not robot.links[0].moving
    np.testing.assert_array_equal(robot.link_poses([]), [from_xyz_rpy((0, 0, 1), (0, 0, 0))])
    assert robot.displacement_m(0.1, []).tolist() == [0.0]


def test_kinematics_stay_within_their_budget() -> None:
    robot = ur3_dh(meshes=True)
    positions = np.full(6, 0.3)
    robot.link_poses(positions)
    fastest = min(_time_ns(robot, positions) for _ in range(200))
    # Budget 0.15 ms a frame on a workstation; the fastest of many runs is free of what else runs here.
    assert fastest < 0.15 * NS_PER_MS


def _time_ns(robot: Robot, positions: NDArray[np.float64]) -> int:
    start = stage_ns()
    robot.link_poses(positions)
    return stage_ns() - start
