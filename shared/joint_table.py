# SPDX-License-Identifier: Apache-2.0
"""A robot as a flat table of moving joints, built from Denavit-Hartenberg rows or a URDF.

Parents precede their children. Fixed joints are multiplied into the frames of their children.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from shared.errors import KinematicsError
from shared.meshes import TriangleMesh
from shared.transforms import Transform, from_rotation_translation, from_xyz_rpy, identity, rotation_about
from shared.urdf import UrdfJoint, UrdfModel

MAX_JOINTS = 128
"""Limit of moving joints: two arms with hands have about a hundred with mimic joints; a longer table is an error."""

MAX_FRAMES = 512
"""Limit of frames: several times the links of the largest humanoid descriptions."""

BASE = -1
"""Index of the body that does not move: the robot's base."""

Z_AXIS = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class DHJoint:
    """A row of standard Denavit-Hartenberg parameters: `Rz(theta) Tz(d) Tx(a) Rx(alpha)`.

    The joint's position is added to `theta_rad` (revolute) or to `d_m` (prismatic).
    """

    name: str
    d_m: float = 0.0
    a_m: float = 0.0
    alpha_rad: float = 0.0
    theta_rad: float = 0.0
    kind: Literal["revolute", "prismatic"] = "revolute"


@dataclass(frozen=True, eq=False)
class Motion:
    """A moving joint of the flat table; body k moves with motion k.

    The joint's value is `multiplier * positions[dof] + offset`, in rad or m. The joint rotates about the unit vector
    `axis`, or shifts along it. `axis` is in the joint's frame, whose pose in the body `parent` is `T_parent_joint`.
    """

    kind: Literal["revolute", "prismatic"]
    parent: int
    T_parent_joint: Transform
    axis: tuple[float, float, float]
    dof: int
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class Attachment:
    """A named frame fixed in a body, with its mesh if it has one."""

    name: str
    body: int
    T_body_frame: Transform
    mesh: TriangleMesh | None = None


def table_of_dh(
    name: str, joints: Sequence[DHJoint], link_meshes: Sequence[TriangleMesh | None], tool: TriangleMesh | None
) -> tuple[list[Motion], list[Attachment]]:
    """Build the table of a serial robot; `link_meshes` starts with link 0, and the tool is in the last link's frame.

    Raises:
        KinematicsError: the number of meshes does not match the number of joints.
    """
    if len(link_meshes) != len(joints) + 1:
        raise KinematicsError(
            f"{name}: expected {len(joints) + 1} link meshes (base and one a joint), got {len(link_meshes)}"
        )
    motions: list[Motion] = []
    attachments = [Attachment("base", BASE, identity(), link_meshes[0])]
    T_parent_joint = identity()
    for index, row in enumerate(joints):
        T_shifted_link = from_xyz_rpy((row.a_m, 0.0, 0.0), (row.alpha_rad, 0.0, 0.0))
        if row.kind == "revolute":
            motions.append(Motion("revolute", index - 1, T_parent_joint, Z_AXIS, index, offset=row.theta_rad))
            T_body_link = from_xyz_rpy((0.0, 0.0, row.d_m), (0.0, 0.0, 0.0)) @ T_shifted_link
        else:
            T_parent_turned = T_parent_joint @ from_xyz_rpy((0.0, 0.0, 0.0), (0.0, 0.0, row.theta_rad))
            motions.append(Motion("prismatic", index - 1, T_parent_turned, Z_AXIS, index, offset=row.d_m))
            T_body_link = T_shifted_link
        attachments.append(Attachment(f"link_{index + 1}", index, T_body_link, link_meshes[index + 1]))
        T_parent_joint = T_body_link
    if tool is not None:
        attachments.append(Attachment("tool", len(joints) - 1, T_parent_joint, tool))
    return motions, attachments


def table_of_urdf(
    path: str | Path,
    model: UrdfModel,
    joints: Sequence[str] | None,
    held_joints: Mapping[str, float],
    tool: TriangleMesh | None,
    tool_parent: str | None,
) -> tuple[list[str], list[Motion], list[Attachment]]:
    """Return the names of the positions, and the table, of a URDF's tree; `path` is for messages.

    Raises:
        KinematicsError: the file has no joint or link of a given name, or a joint is neither listed nor held.
    """
    names = _actuated(path, model, joints, held_joints)
    motions, frames = _flatten(path, model, names, held_joints)
    attachments = [Attachment(link, *frames[link], model.meshes.get(link)) for link in model.links]
    if tool is not None:
        parent = tool_parent or _last_link(path, model)
        if parent not in frames:
            raise KinematicsError(f"{path}: expected a link to hold the tool, got {parent}")
        name = "tool" if "tool" not in frames else "mounted_tool"
        attachments.append(Attachment(name, *frames[parent], tool))
    return names, motions, attachments


def check_table(
    name: str, joint_names: Sequence[str], motions: Sequence[Motion], attachments: Sequence[Attachment]
) -> None:
    """Raise KinematicsError if the flat table is inconsistent."""
    if len(motions) > MAX_JOINTS:
        raise KinematicsError(f"{name}: expected at most {MAX_JOINTS} moving joints, got {len(motions)}")
    if len(attachments) > MAX_FRAMES:
        raise KinematicsError(f"{name}: expected at most {MAX_FRAMES} links, got {len(attachments)}")
    for index, motion in enumerate(motions):
        if not BASE <= motion.parent < index:
            raise KinematicsError(f"{name}: expected joint {index} after its parent, got parent {motion.parent}")
        if not 0 <= motion.dof < len(joint_names):
            raise KinematicsError(f"{name}: expected a dof below {len(joint_names)}, got {motion.dof}")
        if not np.isfinite((*motion.axis, motion.multiplier, motion.offset)).all():
            raise KinematicsError(f"{name}: expected finite numbers in joint {index}, got NaN or infinity")
        if not np.isfinite(motion.T_parent_joint).all():
            raise KinematicsError(f"{name}: expected a finite origin of joint {index}, got NaN or infinity")
        if abs(float(np.linalg.norm(motion.axis)) - 1.0) > 1e-6:
            raise KinematicsError(f"{name}: expected a unit axis in joint {index}, got {motion.axis}")
    for item in attachments:
        if not BASE <= item.body < len(motions):
            raise KinematicsError(f"{name}: expected link {item.name} on a body below {len(motions)}, got {item.body}")
        if not np.isfinite(item.T_body_frame).all():
            raise KinematicsError(f"{name}: expected a finite frame of link {item.name}, got NaN or infinity")
    for what, names in (("joint", list(joint_names)), ("link", [item.name for item in attachments])):
        twice = sorted({entry for entry in names if names.count(entry) > 1})
        if twice:
            raise KinematicsError(f"{name}: expected each {what} once, got {', '.join(twice)} more than once")
    idle = sorted(set(range(len(joint_names))) - {motion.dof for motion in motions})
    if idle:
        raise KinematicsError(
            f"{name}: expected each joint to move something, got {joint_names[idle[0]]} that does not"
        )


def _actuated(path: str | Path, model: UrdfModel, wanted: Sequence[str] | None, held: Mapping[str, float]) -> list[str]:
    """Return the names of the joints whose positions the robot reports, in that order."""
    free = [joint.name for joint in model.joints if joint.kind != "fixed" and joint.mimic is None]
    unknown = [name for name in (*(wanted or ()), *held) if name not in free]
    if unknown:
        raise KinematicsError(
            f"{path}: expected actuated joints out of {', '.join(free) or 'none'}, got {', '.join(unknown)}"
        )
    if wanted is None:
        return [name for name in free if name not in held]
    both = [name for name in wanted if name in held]
    if both:
        raise KinematicsError(f"{path}: expected joints either listed or held, got {', '.join(both)} in both")
    missing = [name for name in free if name not in wanted and name not in held]
    if missing:
        raise KinematicsError(
            f"{path}: expected every actuated joint to be listed or held, got neither for {', '.join(missing)}"
        )
    return list(wanted)


def _flatten(
    path: str | Path, model: UrdfModel, names: Sequence[str], held: Mapping[str, float]
) -> tuple[list[Motion], dict[str, tuple[int, Transform]]]:
    """Return the moving joints, and for every link its body and `T_body_link`."""
    by_name = {joint.name: joint for joint in model.joints}
    motions: list[Motion] = []
    frames = {model.root: (BASE, identity())}
    for joint in model.joints:
        body, T_body_parent = frames[joint.parent]
        T_body_joint = T_body_parent @ joint.T_parent_joint
        leader, multiplier, offset = _leader(path, by_name, joint)
        if joint.kind == "fixed":
            frames[joint.child] = (body, T_body_joint)
        elif leader in names:
            kind: Literal["revolute", "prismatic"] = "prismatic" if joint.kind == "prismatic" else "revolute"
            motions.append(Motion(kind, body, T_body_joint, joint.axis, names.index(leader), multiplier, offset))
            frames[joint.child] = (len(motions) - 1, identity())
        else:
            # A joint that mimics a fixed joint has the value for its leader at zero.
            value = multiplier * held.get(leader, 0.0) + offset
            frames[joint.child] = (body, T_body_joint @ _moved(joint, value))
    return motions, frames


def _leader(path: str | Path, by_name: Mapping[str, UrdfJoint], joint: UrdfJoint) -> tuple[str, float, float]:
    """Return the joint at the end of a chain of mimic joints, and the total multiplier and offset."""
    multiplier, offset = 1.0, 0.0
    visited = [joint.name]
    while joint.mimic is not None:
        offset += multiplier * joint.mimic.offset
        multiplier *= joint.mimic.multiplier
        if joint.mimic.joint not in by_name or joint.mimic.joint in visited:
            raise KinematicsError(
                f"{path}: expected joint {joint.name} to mimic another joint, got {joint.mimic.joint}"
            )
        joint = by_name[joint.mimic.joint]
        visited.append(joint.name)
    return joint.name, multiplier, offset


def _moved(joint: UrdfJoint, value: float) -> Transform:
    if joint.kind == "prismatic":
        return from_rotation_translation(np.eye(3), np.asarray(joint.axis) * value)
    return from_rotation_translation(rotation_about(joint.axis, value), (0.0, 0.0, 0.0))


def _last_link(path: str | Path, model: UrdfModel) -> str:
    """Return the last link of the chain with the most moving joints."""
    depth = {model.root: 0}
    for joint in model.joints:
        depth[joint.child] = depth[joint.parent] + (joint.kind != "fixed")
    parents = {joint.parent for joint in model.joints}
    ends = [link for link in model.links if link not in parents and depth[link] == max(depth.values())]
    if len(ends) != 1:
        raise KinematicsError(f"{path}: expected the tool's parent to be named, got several: {', '.join(ends)}")
    return ends[0]
