# SPDX-License-Identifier: Apache-2.0
"""A robot's links at given joint positions (the paper's Algorithm 5).

Robots described by Denavit-Hartenberg rows with a mesh for each link, or by a URDF, have the same flat table. A unit
receives this table as a plain document and needs neither the file nor a parser.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shared.configuration import sentence
from shared.errors import InputError, KinematicsError
from shared.joint_table import (
    BASE,
    MAX_FRAMES,
    MAX_JOINTS,
    Attachment,
    DHJoint,
    Motion,
    check_table,
    table_of_dh,
    table_of_urdf,
)
from shared.meshes import TriangleMesh, mesh_by_hash
from shared.transforms import Transform, identity, validated
from shared.urdf import MeshKind, read_urdf


@dataclass(frozen=True)
class Link:
    """A link with a mesh. `moving` is False when no actuated joint lies between it and the world."""

    name: str
    mesh: TriangleMesh
    moving: bool
    index: int


class LinkTable(NamedTuple):
    """The links' kinematics as flat arrays, for code that must compute poses faster than `Robot.link_poses`.

    For each of J moving joints, parents first: `parent` (J,), the row of its parent, or `BASE` for the robot's base;
    `dof` (J,), `multiplier` (J,) and `offset` (J,), which give its value `multiplier * positions[dof] + offset`;
    `is_turning` (J,); `axis` (J, 3) in its own frame; `fixed`, `sine`, `versine`, `shift` (J, 4, 4): its
    `T_parent_joint` at value q is `fixed + sin(q) sine + (1 - cos(q)) versine + q shift`.

    For each of L links: `body` (L,), the joint that carries it, or `BASE`; `T_body_link` (L, 4, 4); `chain` (L, J),
    True for the joints that move it; `corners` (L, 8, 3) of its bounding box.
    """

    parent: NDArray[np.int64]
    dof: NDArray[np.int64]
    multiplier: NDArray[np.float64]
    offset: NDArray[np.float64]
    is_turning: NDArray[np.bool_]
    axis: NDArray[np.float64]
    fixed: NDArray[np.float64]
    sine: NDArray[np.float64]
    versine: NDArray[np.float64]
    shift: NDArray[np.float64]
    body: NDArray[np.int64]
    T_body_link: NDArray[np.float64]
    chain: NDArray[np.bool_]
    corners: NDArray[np.float64]


class Robot:
    """Forward kinematics of a tree of joints, with the meshes of its links. Immutable.

    Attributes:
        name: a name for people.
        joint_names: the positions' names, in the order in which positions are given.
        links: the frames with a mesh.
        T_world_base: the pose of the robot's base in the cell.
    """

    def __init__(
        self,
        name: str,
        joint_names: Sequence[str],
        motions: Sequence[Motion],
        attachments: Sequence[Attachment],
        T_world_base: ArrayLike | None = None,
    ) -> None:
        check_table(name, joint_names, motions, attachments)
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
        """The number of joint positions."""
        return len(self.joint_names)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """The names of all frames that `frame_pose` accepts."""
        return tuple(self._frames)

    @property
    def link_table(self) -> LinkTable:
        """The arrays from which `link_poses` and `displacement_m` compute."""
        return LinkTable(
            np.array(self._parent, np.int64),
            self._dof.astype(np.int64),
            self._multiplier,
            self._offset,
            self._is_turning,
            self._axis,
            self._fixed,
            self._sine,
            self._versine,
            self._shift,
            self._link_body.astype(np.int64),
            self._T_body_link,
            self._link_chain,
            self._link_corners,
        )

    def check_joints(self, joints: ArrayLike) -> NDArray[np.float64]:
        """Return `joints` as an array (n,) float64.

        Raises:
            InputError: the count is wrong, or a value is not finite, masked or a boolean.
        """
        if isinstance(joints, np.ma.MaskedArray):
            raise InputError(f"joints: expected {self._expected()}, got a masked array")
        items = joints if isinstance(joints, (list, tuple)) else ()
        if getattr(joints, "dtype", None) == np.bool_ or any(isinstance(item, (bool, np.bool_)) for item in items):
            raise InputError(f"joints: expected {self._expected()}, got booleans")
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
        """Return `T_base_link` (L, 4, 4) of `links` at joint positions (n,), rad or m.

        Raises:
            InputError: the count of joints is wrong, or a value is not finite.
        """
        bodies = self._bodies(self.check_joints(joints))
        return np.asarray(bodies[self._link_body] @ self._T_body_link)

    def frame_pose(self, name: str, joints: ArrayLike) -> Transform:
        """Return `T_base_frame` of a named frame at joint positions (n,), rad or m.

        Raises:
            InputError: the frame does not exist, the count of joints is wrong, or a value is not finite.
        """
        if name not in self._frames:
            raise InputError(f"frame: expected one of {', '.join(self._frames)}, got {name}")
        frame = self._frames[name]
        return np.asarray(self._bodies(self.check_joints(joints))[frame.body] @ frame.T_body_frame)

    def displacement_m(self, joint_uncertainty_rad: ArrayLike, joints: ArrayLike) -> NDArray[np.float64]:
        """Return an upper bound (L,), in metres, of the motion of any point of each link under joint errors.

        Consider the joints one after another from the base outwards. At the turn of one joint, the joints beyond it
        are still at `joints`, so the distance of the link's points from its axis is known. The points move by at most
        the chord of that circle. The sum of the chords holds for angles of any size. Distances are those of the link's
        bounding box.

        Args:
            joint_uncertainty_rad: largest error of the joints, a scalar or (n,), at least 0; in metres for prismatic
                joints.
            joints: (n,) positions, rad or m.

        Raises:
            InputError: the count of values is wrong, or a value is negative or not finite.
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
        """Build a serial robot from standard Denavit-Hartenberg rows.

        Args:
            joints: one row for each joint, from the base outwards.
            link_meshes: one mesh for each link in that link's frame, the base (link 0) first; None for a link without.
            tool: a mesh in the last link's frame.

        Raises:
            KinematicsError: the count of meshes is wrong, or a number is not finite.
        """
        motions, attachments = table_of_dh(name, joints, link_meshes, tool)
        return cls(name, [row.name for row in joints], motions, attachments, T_world_base)

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        meshes: MeshKind = "collision_or_visual",
        joints: Sequence[str] | None = None,
        held_joints: Mapping[str, float] | None = None,
        packages: Mapping[str, Path] | None = None,
        link_meshes: Mapping[str, TriangleMesh] | None = None,
        tool: TriangleMesh | None = None,
        tool_parent: str | None = None,
        T_world_base: ArrayLike | None = None,
    ) -> Robot:
        """Build a robot from a URDF file.

        Args:
            path: the file.
            meshes: the shapes of the file to use for the links.
            joints: actuated joints in the order of the positions; the chain's order when None.
            held_joints: actuated joints without reported positions, and their fixed positions (rad or m).
            packages: folders of ROS packages.
            link_meshes: meshes (link frame) that replace the file's.
            tool: a mesh in the frame of the link `tool_parent`, by default the last link of the longest chain.

        Raises:
            KinematicsError: the file is not a usable robot, or lacks a given name; the text names the file.
            MeshError: a mesh is missing or unusable.
        """
        model = read_urdf(path, meshes, packages, link_meshes)
        names, motions, attachments = table_of_urdf(path, model, joints, held_joints or {}, tool, tool_parent)
        try:
            return cls(model.name, names, motions, attachments, T_world_base)
        except KinematicsError as error:
            raise KinematicsError(f"{path}: {error}") from error

    def document(self) -> dict[str, Any]:
        """Return the robot as a plain document that names its meshes by sha256."""
        return {
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

    def to_document(self) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Return the robot as a plain document, and its meshes' canonical bytes by sha256."""
        return self.document(), {link.mesh.sha256: link.mesh.to_bytes() for link in self.links}

    @classmethod
    def from_document(cls, document: object, meshes: Mapping[str, bytes | TriangleMesh]) -> Robot:
        """Build the robot from a document of `to_document` that came over the network.

        Raises:
            KinematicsError: the document is malformed or inconsistent.
            MeshError: a mesh is missing or malformed.
        """
        try:
            checked = _RobotDocument.model_validate(document)
            # Each mesh is read once, even when several frames carry it.
            known = dict(meshes)
            for row in checked.frames:
                if row.mesh is not None:
                    known[row.mesh] = mesh_by_hash(known, row.mesh, row.name)
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
                        None if row.mesh is None else mesh_by_hash(known, row.mesh, row.name),
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
        """Return `T_base_body` (J + 1, 4, 4). The last is the base itself, so that index -1 (`BASE`) selects it."""
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


def _local_terms(motions: Sequence[Motion]) -> tuple[NDArray[np.float64], ...]:
    """Return constant terms (J, 4, 4) of `T_parent_body = fixed + sin(q) sine + (1 - cos(q)) versine + q shift`.

    This is Rodrigues' formula multiplied by the joint's origin, so that all joints are evaluated at once.
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
    """Return the motions between the base and a body, including the body's own."""
    found: set[int] = set()
    while body != BASE:
        found.add(body)
        body = motions[body].parent
    return found


def _box_corners(mesh: TriangleMesh) -> NDArray[np.float64]:
    """Return the eight corners (8, 3) of a mesh's bounding box, mesh frame."""
    low, high = mesh.bounds_m
    chosen = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, 8).T
    return np.where(chosen, high, low)
