# SPDX-License-Identifier: Apache-2.0
"""The cell: the watched workspace and every known body in it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shared.cell_file import (
    MAX_BODIES,
    CellFile,
    DHFile,
    Name,
    RobotFile,
    ShapeFile,
    named_file,
    named_folder,
    read_cell_file,
)
from shared.configuration import sentence
from shared.errors import CellError, InputError, KinematicsError, MeshError
from shared.joint_table import DHJoint
from shared.kinematics import Robot
from shared.lattice import Lattice, block_lattice
from shared.meshes import MAX_COORDINATE_M, TriangleMesh, box_mesh, cylinder_mesh, load_mesh, mesh_by_hash
from shared.transforms import Transform, validated


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """A named body of the cell; `T_world_mesh` (4, 4) is read-only."""

    name: str
    mesh: TriangleMesh
    T_world_mesh: Transform

    def __post_init__(self) -> None:
        pose = validated(self.T_world_mesh, f"{self.name} T_world_mesh")
        farthest_m = float(np.abs(pose[:3, 3]).max())
        if farthest_m > MAX_COORDINATE_M:
            raise InputError(
                f"{self.name} T_world_mesh: expected a position within {MAX_COORDINATE_M:g} m, got {farthest_m:.4g} m"
            )
        pose.flags.writeable = False
        object.__setattr__(self, "T_world_mesh", pose)


@dataclass(frozen=True, eq=False)
class Board:
    """The calibration board, in the terms of OpenCV's aruco module.

    Attributes:
        kind: `charuco` (chessboard with a marker in every white square) or `grid` (markers with gaps).
        columns, rows: squares (charuco) or markers (grid) along x and y.
        square_m: edge of a square (charuco), or distance from marker to marker (grid: marker and gap).
        marker_m: edge of a marker.
        dictionary: name of OpenCV's dictionary.
        first_marker: the lowest marker id on the board.
        T_world_board: (4, 4), read-only; origin at the printed pattern's top left corner, x to the right,
            y down, z into the board.
    """

    kind: Literal["charuco", "grid"]
    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str
    first_marker: int
    T_world_board: Transform

    def __post_init__(self) -> None:
        pose = validated(self.T_world_board, "T_world_board")
        pose.flags.writeable = False
        object.__setattr__(self, "T_world_board", pose)

    def to_document(self) -> dict[str, Any]:
        """Return the board as a plain document."""
        return {**vars(self), "T_world_board": self.T_world_board.tolist()}

    @classmethod
    def from_document(cls, document: object) -> Board:
        """Build the board from a document of `to_document` that came over the network.

        Raises:
            CellError: the document is malformed.
        """
        try:
            return cls(**dict(_BoardDocument.model_validate(document)))
        except ValidationError as error:
            raise CellError(f"board document: {sentence(error)}") from error
        except InputError as error:
            raise CellError(f"board document: {error}") from error


@dataclass(frozen=True, eq=False)
class Cell:
    """The watched box and the known bodies in it. Immutable; a change makes a new cell.

    Attributes:
        name: a name for people.
        box_min_m, box_max_m: (3,) corners of the box, world frame, read-only.
        static: CAD bodies that never move.
        objects: known bodies that `with_object_pose` moves.
        robot: the robot with its tool, or None.
        board: the calibration board, from which cameras compute their pose; or None.
    """

    name: str
    box_min_m: NDArray[np.float64]
    box_max_m: NDArray[np.float64]
    static: tuple[PlacedMesh, ...] = ()
    objects: tuple[PlacedMesh, ...] = ()
    robot: Robot | None = None
    board: Board | None = None

    def __post_init__(self) -> None:
        low = np.array(self.box_min_m, dtype=np.float64)
        high = np.array(self.box_max_m, dtype=np.float64)
        if low.shape != (3,) or high.shape != (3,) or not np.isfinite((low, high)).all() or (high <= low).any():
            span = f"{low.tolist()} to {high.tolist()}"
            raise CellError(f"cell {self.name}: expected box_max_m above box_min_m on three axes, got {span}")
        names = [body.name for body in (*self.static, *self.objects)]
        if len(set(names)) != len(names):
            raise CellError(f"cell {self.name}: expected each name once among static and objects, got {names}")
        low.flags.writeable = False
        high.flags.writeable = False
        object.__setattr__(self, "box_min_m", low)
        object.__setattr__(self, "box_max_m", high)

    @classmethod
    def load(cls, path: str | Path) -> Cell:
        """Read `cell.yaml` and every file that it names.

        Raises:
            CellError: the file or a file that it names is missing or invalid; one sentence that names the file,
                the key and the value.
        """
        if not isinstance(path, (str, Path)):
            raise CellError(f"cell: expected the path of a cell file as text or Path, got {type(path).__name__}")
        file = Path(path)
        content = read_cell_file(file)
        try:
            return cls(
                content.name,
                np.array(content.box.min),
                np.array(content.box.max),
                tuple(
                    PlacedMesh(body.name, _shape(file, f"static[{i}]", body, body.name), body.pose.transform())
                    for i, body in enumerate(content.static)
                ),
                tuple(
                    PlacedMesh(body.name, _shape(file, f"objects[{i}]", body, body.name), body.pose.transform())
                    for i, body in enumerate(content.objects)
                ),
                None if content.robot is None else _robot(file, content.robot),
                board_of(content),
            )
        except InputError as error:
            raise CellError(f"{file}: {error}") from error

    def lattice(self, voxel_size_m: float) -> Lattice:
        """Return the voxel grid of this cell's box.

        Raises:
            InputError: the box would need too many voxels of this size.
        """
        return Lattice.covering(self.box_min_m, self.box_max_m, voxel_size_m)

    def blocks(self, block_size_m: float) -> Lattice:
        """Return the lattice of blocks in which units report what they see through.

        `block_lattice` makes the blocks larger when the box would need more than `MAX_BLOCKS`.
        """
        return block_lattice(self.box_min_m, self.box_max_m, block_size_m)

    def with_object_pose(self, name: str, T_world_mesh: ArrayLike) -> Cell:
        """Return a copy of the cell with another pose of one object.

        Raises:
            InputError: no object has this name, or the pose is not a rigid transform.
        """
        names = [body.name for body in self.objects]
        if name not in names:
            raise InputError(f"object: expected one of {', '.join(names) or 'none'}, got {name}")
        moved = tuple(
            PlacedMesh(body.name, body.mesh, validated(T_world_mesh, f"{name} T_world_mesh"))
            if body.name == name
            else body
            for body in self.objects
        )
        return replace(self, objects=moved)

    @cached_property
    def version(self) -> str:
        """Hash of the cell's document as hex: equal cells have equal versions."""
        text = json.dumps(self.document(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def meshes(self) -> dict[str, TriangleMesh]:
        """All meshes by sha256, each once."""
        links = [] if self.robot is None else [link.mesh for link in self.robot.links]
        bodies = [body.mesh for body in (*self.static, *self.objects)]
        return {mesh.sha256: mesh for mesh in (*links, *bodies)}

    def document(self) -> dict[str, Any]:
        """Return the cell as a plain document that names its meshes by sha256."""
        return {
            "name": self.name,
            "box_min_m": self.box_min_m.tolist(),
            "box_max_m": self.box_max_m.tolist(),
            "static": [_body_document(body) for body in self.static],
            "objects": [_body_document(body) for body in self.objects],
            "robot": None if self.robot is None else self.robot.document(),
            "board": None if self.board is None else self.board.to_document(),
        }

    def to_document(self) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Return the cell as a plain document, and its meshes' canonical bytes by sha256."""
        return self.document(), {sha256: mesh.to_bytes() for sha256, mesh in self.meshes.items()}

    @classmethod
    def from_document(cls, document: object, meshes: Mapping[str, bytes], like: Cell | None = None) -> Cell:
        """Build the cell from a document of `to_document` that came over the network.

        Meshes and a robot that are equal in the cell `like` are taken from it as the same objects. `meshes` need not
        contain these meshes.

        Raises:
            CellError: the document is malformed, a mesh is missing, or a mesh does not match its hash.
        """
        try:
            checked = _CellDocument.model_validate(document)
            # Each mesh is read once, even when several bodies share it.
            known: dict[str, bytes | TriangleMesh] = {**meshes, **(like.meshes if like else {})}
            static = tuple(_placed(body, known) for body in checked.static)
            objects = tuple(_placed(body, known) for body in checked.objects)
            robot = None if checked.robot is None else Robot.from_document(checked.robot, known)
            if like is not None and like.robot is not None and robot is not None:
                robot = like.robot if like.robot.document() == robot.document() else robot
            return cls(
                checked.name,
                np.array(checked.box_min_m),
                np.array(checked.box_max_m),
                static,
                objects,
                robot,
                None if checked.board is None else Board.from_document(checked.board),
            )
        except ValidationError as error:
            raise CellError(f"cell document: {sentence(error)}") from error
        except (InputError, MeshError, KinematicsError) as error:
            raise CellError(f"cell document: {error}") from error


class _DocumentModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class _BodyDocument(_DocumentModel):
    name: Name
    mesh: str
    T_world_mesh: list[list[float]]


class _BoardDocument(_DocumentModel):
    kind: Literal["charuco", "grid"]
    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str
    first_marker: int
    T_world_board: list[list[float]]


class _CellDocument(_DocumentModel):
    name: Name
    box_min_m: tuple[float, float, float]
    box_max_m: tuple[float, float, float]
    static: list[_BodyDocument] = Field(max_length=MAX_BODIES)
    objects: list[_BodyDocument] = Field(max_length=MAX_BODIES)
    robot: dict[str, Any] | None
    board: dict[str, Any] | None


def _body_document(body: PlacedMesh) -> dict[str, Any]:
    return {"name": body.name, "mesh": body.mesh.sha256, "T_world_mesh": body.T_world_mesh.tolist()}


def _placed(body: _BodyDocument, known: dict[str, bytes | TriangleMesh]) -> PlacedMesh:
    pose = validated(body.T_world_mesh, f"{body.name} T_world_mesh")
    mesh = known[body.mesh] = mesh_by_hash(known, body.mesh, body.name)
    return PlacedMesh(body.name, mesh, pose)


def _shape(file: Path, key: str, shape: ShapeFile, name: str) -> TriangleMesh:
    """Return the mesh of a `mesh`, `box` or `cylinder`, in its own frame."""
    if shape.mesh is None:
        if shape.box is not None:
            return box_mesh(name, shape.box)
        assert shape.cylinder is not None
        return cylinder_mesh(name, shape.cylinder.radius, shape.cylinder.length)
    try:
        return load_mesh(named_file(file, f"{key}.mesh", shape.mesh), shape.scale, name)
    except MeshError as error:
        raise CellError(f"{file}: {key}.mesh: {error}") from error


def _link_mesh(file: Path, key: str, shape: ShapeFile | None, name: str) -> TriangleMesh | None:
    """Return a shape's mesh in the frame of the link that carries it."""
    if shape is None:
        return None
    return _shape(file, key, shape, name).transformed(shape.pose.transform())


def _robot(file: Path, content: RobotFile) -> Robot:
    tool = _link_mesh(file, "robot.tool", content.tool, "tool")
    T_world_base = content.pose.transform()
    try:
        if content.dh is not None:
            robot = _dh_robot(file, content.dh, tool, T_world_base)
        else:
            robot = _urdf_robot(file, content, tool, T_world_base)
    except (KinematicsError, MeshError) as error:
        raise CellError(f"{file}: robot: {error}") from error
    if not robot.links:
        raise CellError(f"{file}: robot: expected at least one link with a mesh, got none")
    return robot


def _dh_robot(file: Path, content: DHFile, tool: TriangleMesh | None, T_world_base: Transform) -> Robot:
    rows = [
        DHJoint(
            row.name or f"joint_{index + 1}",
            row.d_m,
            row.a_m,
            float(np.radians(row.alpha_deg)),
            float(np.radians(row.theta_deg)),
            row.kind,
        )
        for index, row in enumerate(content.joints)
    ]
    link_meshes = [_link_mesh(file, "robot.dh.base", content.base, "base")]
    for index, row in enumerate(content.joints):
        link_meshes.append(_link_mesh(file, f"robot.dh.joints[{index}].link", row.link, f"link_{index + 1}"))
    return Robot.from_dh(rows, link_meshes, tool, "robot", T_world_base)


def _urdf_robot(file: Path, content: RobotFile, tool: TriangleMesh | None, T_world_base: Transform) -> Robot:
    assert content.urdf is not None
    replaced = {
        link: mesh
        for link, shape in content.link_meshes.items()
        if (mesh := _link_mesh(file, f"robot.link_meshes.{link}", shape, link)) is not None
    }
    return Robot.from_urdf(
        named_file(file, "robot.urdf", content.urdf),
        meshes=content.meshes,
        joints=content.joints,
        held_joints=content.held_joints,
        packages={
            name: named_folder(file, f"robot.packages.{name}", folder) for name, folder in content.packages.items()
        },
        link_meshes=replaced,
        tool=tool,
        tool_parent=content.tool.parent if content.tool is not None else None,
        T_world_base=T_world_base,
    )


def board_of(content: CellFile) -> Board | None:
    """Return the board that a cell file describes, or None."""
    if content.board is None:
        return None
    fields = content.board.model_dump(exclude={"pose"})
    return Board(**fields, T_world_board=content.board.pose.transform())
