# SPDX-License-Identifier: Apache-2.0
"""A robot's links at given joint positions (the paper's Algorithm 5).

However a robot was described, by Denavit-Hartenberg rows with a mesh a link or by a URDF, it becomes
the same flat table: moving joints only, parents first, every fixed joint multiplied into what hangs on it.
A unit is sent that table as a plain document and needs neither the file nor a parser.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shared.configuration import sentence
from shared.errors import InputError, KinematicsError
from shared.meshes import TriangleMesh, mesh_by_hash
from shared.transforms import Transform, from_rotation_translation, identity, rotation_about, validated
from shared.urdf import MeshKind, UrdfJoint, UrdfModel, read_urdf

MAX_JOINTS = 128
"""Two arms with hands have a hundred, mimic joints counted; a longer table is a mistake."""

MAX_FRAMES = 512
"""Links of the largest humanoid descriptions, several times over."""

BASE = -1
"""The body that does not move: the robot's base."""


@dataclass(frozen=True)
class Link:
    """A link that carries a mesh. `moving` is false when no actuated joint lies between the world and it."""

    name: str
    mesh: TriangleMesh
    moving: bool
    index: int


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
    """A moving joint of the flat table. Body k is what moves with motion k.

    Its position is `multiplier * positions[dof] + offset`, in rad or m; it turns about, or shifts along,
    the unit vector `axis` of the frame `T_parent_joint` in the body `parent`.
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
    """A named frame fixed in a body, with the mesh that stands in it, if any."""

    name: str
    body: int
    T_body_frame: Transform
    mesh: TriangleMesh | None = None


class Robot:
    """Forward kinematics of a tree of joints, and the meshes that hang on it. Immutable.

    Attributes:
        name: for people.
        joint_names: the positions' names, in the order in which positions are given.
        links: those frames that carry a mesh.
        T_world_base: where the robot's base stands in the cell.
    """

    def __init__(
        self,
        name: str,
        joint_names: Sequence[str],
        motions: Sequence[Motion],
        attachments: Sequence[Attachment],
        T_world_base: ArrayLike | None = None,
    ) -> None:
        _check_table(name, joint_names, motions, attachments)
        self.name = name
        self.joint_names = tuple(joint_names)
        self.T_world_base = validated(identity() if T_world_base is None else T_world_base, "T_world_base")
        self.T_world_base.flags.writeable = False
        self._motions = tuple(motions)
        self._attachments = tuple(attachments)
        self._frames = {attachment.name: attachment for attachment in attachments}
        carriers = [(item, item.mesh) for item in attachments if item.mesh is not None]
        self.links = tuple(
            Link(item.name, mesh, item.body != BASE, index) for index, (item, mesh) in enumerate(carriers)
        )

        count = len(motions)
        self._parent = [motion.parent for motion in motions]
        self._dof = np.array([motion.dof for motion in motions], dtype=np.intp)
        self._multiplier = np.array([motion.multiplier for motion in motions])
        self._offset = np.array([motion.offset for motion in motions])
        self._axis = np.array([motion.axis for motion in motions]).reshape(count, 3)
        self._is_turning = np.array([motion.kind == "revolute" for motion in motions], dtype=bool)
        self._fixed, self._sine, self._versine, self._shift = _local_terms(motions)
        self._link_body = np.array([item.body for item, _ in carriers], dtype=np.intp)
        self._T_body_link = np.array([item.T_body_frame for item, _ in carriers]).reshape(-1, 4, 4)
        self._link_chain = np.array(
            [[k in _chain(motions, item.body) for k in range(count)] for item, _ in carriers], dtype=bool
        ).reshape(len(carriers), count)
        self._link_corners = np.array([_box_corners(mesh) for _, mesh in carriers]).reshape(-1, 8, 3)

    @property
    def joint_count(self) -> int:
        """How many positions a pose takes."""
        return len(self.joint_names)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """All frames that `frame_pose` knows."""
        return tuple(self._frames)

    def check_joints(self, joints: ArrayLike) -> NDArray[np.float64]:
        """Return `joints` as (n,) float64.

        Raises:
            InputError: not as many finite numbers as the robot has joints.
        """
        try:
            positions = np.asarray(joints, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"joints: expected {self._expected()}, got {type(joints).__name__}") from error
        if positions.shape != (self.joint_count,):
            raise InputError(f"joints: expected {self._expected()}, got shape {positions.shape}")
        if not np.isfinite(positions).all():
            raise InputError(f"joints: expected {self._expected()}, got {positions.tolist()}")
        return positions

    def link_poses(self, joints: ArrayLike) -> NDArray[np.float64]:
        """`T_base_link` (L, 4, 4) of `links` at joint positions (n,), rad or m.

        Raises:
            InputError: wrong number of joints, or one is not finite.
        """
        bodies = self._bodies(self.check_joints(joints))
        return np.asarray(bodies[self._link_body] @ self._T_body_link)

    def frame_pose(self, name: str, joints: ArrayLike) -> Transform:
        """`T_base_frame` of a named frame at joint positions (n,), rad or m.

        Raises:
            InputError: no such frame, wrong number of joints, or one is not finite.
        """
        if name not in self._frames:
            raise InputError(f"frame: expected one of {', '.join(self._frames)}, got {name}")
        frame = self._frames[name]
        return np.asarray(self._bodies(self.check_joints(joints))[frame.body] @ frame.T_body_frame)

    def displacement_m(self, joint_uncertainty_rad: ArrayLike, joints: ArrayLike) -> NDArray[np.float64]:
        """Upper bound (L,), metres, of how far any point of each link moves when every joint is off.

        Turn the joints one after another from the base outwards: when a joint's turn comes, those beyond it
        still stand at `joints`, so the distance of the link's points from its axis is known, and they move
        by at most the chord of that circle. The sum holds for angles of any size. Distances are those of the
        link's bounding box.

        Args:
            joint_uncertainty_rad: by how much at most, a scalar or (n,), at least 0; metres for prismatic joints.
            joints: (n,) positions.

        Raises:
            InputError: wrong number of values, negative or not finite.
        """
        positions = self.check_joints(joints)
        uncertainty = np.asarray(joint_uncertainty_rad, dtype=np.float64)
        if uncertainty.shape not in ((), (self.joint_count,)):
            raise InputError(
                f"joint_uncertainty_rad: expected one value or {self._expected()}, got shape {uncertainty.shape}"
            )
        if not (np.isfinite(uncertainty).all() and (uncertainty >= 0.0).all()):
            raise InputError(f"joint_uncertainty_rad: expected finite values of at least 0, got {uncertainty.tolist()}")
        if not self._parent or not self.links:
            return np.zeros(len(self.links))
        off_by = np.broadcast_to(uncertainty, (self.joint_count,))[self._dof] * np.abs(self._multiplier)
        bodies = self._bodies(positions)
        points = bodies[:-1, :3, 3]
        axes = np.einsum("kij,kj->ki", bodies[:-1, :3, :3], self._axis)
        T_base_link = bodies[self._link_body] @ self._T_body_link
        corners = self._link_corners @ T_base_link[:, :3, :3].swapaxes(1, 2) + T_base_link[:, None, :3, 3]
        arms = corners[:, None, :, :] - points[None, :, None, :]
        along = np.einsum("lkci,ki->lkc", arms, axes)
        radius_squared = np.maximum(np.einsum("lkci,lkci->lkc", arms, arms) - along**2, 0.0).max(axis=2)
        chord = 2.0 * np.sin(np.minimum(off_by, np.pi) / 2.0) * np.sqrt(radius_squared)
        moved = np.where(self._is_turning, chord, off_by)
        return np.asarray((moved * self._link_chain).sum(axis=1))

    @classmethod
    def from_dh(
        cls,
        joints: Sequence[DHJoint],
        link_meshes: Sequence[TriangleMesh | None],
        tool: TriangleMesh | None = None,
        name: str = "robot",
        T_world_base: ArrayLike | None = None,
    ) -> Robot:
        """A serial robot of standard Denavit-Hartenberg rows.

        Args:
            joints: a row a joint, from the base outwards.
            link_meshes: one a link in that link's frame, the base (link 0) first; None where there is none.
            tool: in the last link's frame.

        Raises:
            KinematicsError: the counts do not match, or a number is not finite.
        """
        if len(link_meshes) != len(joints) + 1:
            raise KinematicsError(
                f"{name}: expected {len(joints) + 1} link meshes (base and one a joint), got {len(link_meshes)}"
            )
        motions: list[Motion] = []
        attachments = [Attachment("base", BASE, identity(), link_meshes[0])]
        T_parent_joint = identity()
        for index, row in enumerate(joints):
            turned = from_rotation_translation(rotation_about((0.0, 0.0, 1.0), row.theta_rad), (0.0, 0.0, 0.0))
            shifted = from_rotation_translation(np.eye(3), (0.0, 0.0, row.d_m))
            rest = from_rotation_translation(rotation_about((1.0, 0.0, 0.0), row.alpha_rad), (row.a_m, 0.0, 0.0))
            if row.kind == "revolute":
                motion = Motion("revolute", index - 1, T_parent_joint, (0.0, 0.0, 1.0), index, 1.0, row.theta_rad)
                T_body_link = shifted @ rest
            else:
                T_turned = T_parent_joint @ turned
                motion = Motion("prismatic", index - 1, T_turned, (0.0, 0.0, 1.0), index, 1.0, row.d_m)
                T_body_link = rest
            motions.append(motion)
            attachments.append(Attachment(f"link_{index + 1}", index, T_body_link, link_meshes[index + 1]))
            T_parent_joint = T_body_link
        if tool is not None:
            attachments.append(Attachment("tool", len(joints) - 1, T_parent_joint, tool))
        return cls(name, [row.name for row in joints], motions, attachments, T_world_base)

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        meshes: MeshKind = "collision",
        joints: Sequence[str] | None = None,
        held_joints: Mapping[str, float] | None = None,
        packages: Mapping[str, Path] | None = None,
        link_meshes: Mapping[str, TriangleMesh] | None = None,
        tool: TriangleMesh | None = None,
        tool_parent: str | None = None,
        T_world_base: ArrayLike | None = None,
    ) -> Robot:
        """The robot of a URDF file.

        Args:
            path: the file.
            meshes: which of its shapes stand for the links.
            joints: actuated joints in the order in which positions will come; the chain's order when absent.
            held_joints: actuated joints of which no position will come, and where they stand (rad or m).
            packages: folders of ROS packages.
            link_meshes: meshes (link frame) to take instead of the file's.
            tool: a mesh in the frame of the link `tool_parent`, by default the last link of the longest chain.

        Raises:
            KinematicsError: the file is no usable robot, or a name is not in it; names the file.
            MeshError: a mesh is missing or unusable.
        """
        model = read_urdf(path, meshes, packages, link_meshes)
        held = dict(held_joints or {})
        names = _actuated(path, model, joints, held)
        motions, frames = _flatten(path, model, names, held)
        attachments = [Attachment(link, *frames[link], model.meshes.get(link)) for link in model.links]
        if tool is not None:
            parent = tool_parent or _last_link(path, model)
            if parent not in frames:
                raise KinematicsError(f"{path}: expected a link to hold the tool, got {parent}")
            attachments.append(Attachment("tool", *frames[parent], tool))
        try:
            return cls(model.name, names, motions, attachments, T_world_base)
        except KinematicsError as error:
            raise KinematicsError(f"{path}: {error}") from error

    def to_document(self) -> tuple[dict[str, Any], dict[str, bytes]]:
        """The robot as a plain document, and its meshes' canonical bytes by sha256."""
        document = {
            "name": self.name,
            "joint_names": list(self.joint_names),
            "T_world_base": self.T_world_base.tolist(),
            "motions": [
                {
                    "kind": motion.kind,
                    "parent": motion.parent,
                    "T_parent_joint": motion.T_parent_joint.tolist(),
                    "axis": list(motion.axis),
                    "dof": motion.dof,
                    "multiplier": motion.multiplier,
                    "offset": motion.offset,
                }
                for motion in self._motions
            ],
            "frames": [
                {
                    "name": item.name,
                    "body": item.body,
                    "T_body_frame": item.T_body_frame.tolist(),
                    "mesh": None if item.mesh is None else item.mesh.sha256,
                }
                for item in self._attachments
            ],
        }
        return document, {link.mesh.sha256: link.mesh.to_bytes() for link in self.links}

    @classmethod
    def from_document(cls, document: object, meshes: Mapping[str, bytes]) -> Robot:
        """The robot of `to_document`, as it came over the network.

        Raises:
            KinematicsError: the document is malformed or contradicts itself.
            MeshError: a mesh is missing or malformed.
        """
        try:
            checked = _RobotDocument.model_validate(document)
            return cls(
                checked.name,
                checked.joint_names,
                [
                    Motion(
                        row.kind,
                        row.parent,
                        validated(row.T_parent_joint, "T_parent_joint"),
                        row.axis,
                        row.dof,
                        row.multiplier,
                        row.offset,
                    )
                    for row in checked.motions
                ],
                [
                    Attachment(
                        row.name,
                        row.body,
                        validated(row.T_body_frame, "T_body_frame"),
                        None if row.mesh is None else mesh_by_hash(meshes, row.mesh, row.name),
                    )
                    for row in checked.frames
                ],
                checked.T_world_base,
            )
        except ValidationError as error:
            raise KinematicsError(f"robot document: {sentence(error)}") from error
        except InputError as error:
            raise KinematicsError(f"robot document: {error}") from error

    def _expected(self) -> str:
        return f"{self.joint_count} finite positions ({', '.join(self.joint_names)})"

    def _bodies(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """`T_base_body` (J + 1, 4, 4); the last one is the base itself, so that index -1 (`BASE`) finds it."""
        values = self._multiplier * positions[self._dof] + self._offset
        turn = values * self._is_turning
        local = (
            self._fixed
            + np.sin(turn)[:, None, None] * self._sine
            + (1.0 - np.cos(turn))[:, None, None] * self._versine
            + values[:, None, None] * self._shift
        )
        bodies = np.empty((len(local) + 1, 4, 4))
        bodies[-1] = np.eye(4)
        for index, parent in enumerate(self._parent):
            np.matmul(bodies[parent], local[index], out=bodies[index])
        return bodies


class _MotionDocument(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: Literal["revolute", "prismatic"]
    parent: int
    T_parent_joint: list[list[float]]
    axis: tuple[float, float, float]
    dof: int
    multiplier: float
    offset: float


class _FrameDocument(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    body: int
    T_body_frame: list[list[float]]
    mesh: str | None


class _RobotDocument(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    joint_names: list[str]
    T_world_base: list[list[float]]
    motions: list[_MotionDocument] = Field(max_length=MAX_JOINTS)
    frames: list[_FrameDocument] = Field(max_length=MAX_FRAMES)


def _check_table(
    name: str, joint_names: Sequence[str], motions: Sequence[Motion], attachments: Sequence[Attachment]
) -> None:
    """Raise KinematicsError where the flat table contradicts itself."""
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


def _local_terms(motions: Sequence[Motion]) -> tuple[NDArray[np.float64], ...]:
    """Constant terms (J, 4, 4) each of `T_parent_body = fixed + sin(q) sine + (1 - cos(q)) versine + q shift`.

    Rodrigues' formula with the joint's origin multiplied in, so that all joints are turned at once.
    """
    fixed, sine, versine, shift = np.zeros((4, len(motions), 4, 4))
    for index, motion in enumerate(motions):
        rotation = motion.T_parent_joint[:3, :3]
        fixed[index] = motion.T_parent_joint
        if motion.kind == "revolute":
            x, y, z = motion.axis
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            sine[index, :3, :3] = rotation @ cross
            versine[index, :3, :3] = rotation @ cross @ cross
        else:
            shift[index, :3, 3] = rotation @ np.asarray(motion.axis)
    return fixed, sine, versine, shift


def _chain(motions: Sequence[Motion], body: int) -> set[int]:
    """The motions between the base and a body, the body's own included."""
    found: set[int] = set()
    while body != BASE:
        found.add(body)
        body = motions[body].parent
    return found


def _box_corners(mesh: TriangleMesh) -> NDArray[np.float64]:
    """The eight corners (8, 3) of a mesh's bounding box, mesh frame."""
    low, high = mesh.bounds_m
    chosen = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, 8).T
    return np.where(chosen, high, low)


def _actuated(path: str | Path, model: UrdfModel, wanted: Sequence[str] | None, held: Mapping[str, float]) -> list[str]:
    """Names of the joints whose positions will come, in that order."""
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
    """The moving joints, and for every link its body and `T_body_link`."""
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
            # What follows a fixed joint stands where its leader would stand at zero.
            value = multiplier * held.get(leader, 0.0) + offset
            frames[joint.child] = (body, T_body_joint @ _moved(joint, value))
    return motions, frames


def _leader(path: str | Path, by_name: Mapping[str, UrdfJoint], joint: UrdfJoint) -> tuple[str, float, float]:
    """The joint that is followed in the end, and by what multiplier and offset."""
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
    """The end of the one chain that passes the most moving joints."""
    depth = {model.root: 0}
    for joint in model.joints:
        depth[joint.child] = depth[joint.parent] + (joint.kind != "fixed")
    parents = {joint.parent for joint in model.joints}
    ends = [link for link in model.links if link not in parents and depth[link] == max(depth.values())]
    if len(ends) != 1:
        raise KinematicsError(f"{path}: expected the tool's parent to be named, got several: {', '.join(ends)}")
    return ends[0]
