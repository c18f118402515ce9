# SPDX-License-Identifier: Apache-2.0
"""`cell.yaml` as checked models, and the paths of the files that it names.

Lengths are in metres. Angles are in degrees, since people write the file. `docs/cell.md` explains every key.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from shared.errors import CellError
from shared.joint_table import MAX_JOINTS
from shared.meshes import MAX_COORDINATE_M
from shared.text_files import parse_yaml, read_text
from shared.transforms import Transform, from_xyz_rpy

MAX_BODIES = 1000
"""Limit for static bodies, and for objects: a cell exported part by part stays below it, a runaway script may not."""

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Coordinate = Annotated[float, Field(strict=True, ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Length = Annotated[float, Field(strict=True, gt=0.0, le=MAX_COORDINATE_M)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Angles = tuple[Number, Number, Number]
Name = Annotated[str, Field(strict=True, min_length=1, max_length=64, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PoseFile(_Model):
    """A pose: rotate by roll about x, pitch about y, yaw about z (fixed axes, degrees), then shift by `xyz`."""

    xyz: Vector = (0.0, 0.0, 0.0)
    rpy_deg: Angles = (0.0, 0.0, 0.0)

    def transform(self) -> Transform:
        """Return `T_parent_this` (4, 4)."""
        return from_xyz_rpy(self.xyz, np.radians(self.rpy_deg))


class BoxFile(_Model):
    """The watched box by two opposite corners, world frame."""

    min: Vector
    max: Vector

    @model_validator(mode="after")
    def _ordered(self) -> BoxFile:
        if any(high <= low for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError(f"expected max above min on three axes, got {list(self.min)} to {list(self.max)}")
        return self


class CylinderFile(_Model):
    """A cylinder about its own z axis."""

    radius: Length
    length: Length


class ShapeFile(_Model):
    """A mesh file or a primitive, with its pose in its parent's frame."""

    mesh: str | None = None
    scale: Annotated[float, Field(strict=True, gt=0.0, le=1000.0)] = 1.0
    box: tuple[Length, Length, Length] | None = None
    cylinder: CylinderFile | None = None
    pose: PoseFile = PoseFile()

    @model_validator(mode="after")
    def _one_shape(self) -> ShapeFile:
        given = [key for key in ("mesh", "box", "cylinder") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of mesh, box or cylinder, got {' and '.join(given) or 'none'}")
        if self.mesh is None and "scale" in self.model_fields_set:
            raise ValueError("expected scale only beside mesh, since a primitive is in metres")
        return self


class BodyFile(ShapeFile):
    """A named body of the cell, with its pose in the world frame."""

    name: Name


class ToolFile(ShapeFile):
    """A tool mounted on the robot, with its pose in the frame of the link `parent`."""

    parent: str | None = None


class DHJointFile(_Model):
    """A row of standard Denavit-Hartenberg parameters and the mesh of the link after the joint."""

    name: Name | None = None
    kind: Literal["revolute", "prismatic"] = "revolute"
    d_m: Coordinate = 0.0
    a_m: Coordinate = 0.0
    alpha_deg: Number = 0.0
    theta_deg: Number = 0.0
    link: ShapeFile | None = None


class DHFile(_Model):
    """A serial robot described by Denavit-Hartenberg rows."""

    base: ShapeFile | None = None
    joints: tuple[DHJointFile, ...] = Field(min_length=1, max_length=MAX_JOINTS)


class RobotFile(_Model):
    """The robot: either a URDF or DH rows."""

    urdf: str | None = None
    meshes: Literal["collision_or_visual", "collision", "visual"] = "collision_or_visual"
    joints: tuple[str, ...] | None = None
    held_joints: dict[str, Number] = Field(default_factory=dict)
    packages: dict[str, str] = Field(default_factory=dict)
    link_meshes: dict[str, ShapeFile] = Field(default_factory=dict)
    dh: DHFile | None = None
    tool: ToolFile | None = None
    pose: PoseFile = PoseFile()

    @model_validator(mode="after")
    def _one_description(self) -> RobotFile:
        if (self.urdf is None) == (self.dh is None):
            raise ValueError(f"expected either urdf or dh, got {'neither' if self.urdf is None else 'both'}")
        only_urdf = {"meshes", "joints", "held_joints", "packages", "link_meshes"} & self.model_fields_set
        if self.dh is not None and only_urdf:
            raise ValueError(f"expected {', '.join(sorted(only_urdf))} only beside urdf, got dh")
        if self.dh is not None and self.tool is not None and self.tool.parent is not None:
            raise ValueError("expected tool.parent only beside urdf, since a dh robot holds it in its last link")
        return self


class BoardFile(_Model):
    """The calibration board, in the terms of OpenCV's aruco module.

    Its frame: origin at the printed pattern's top left corner, x to the right, y down, z into the board.
    """

    kind: Literal["charuco", "grid"] = "charuco"
    columns: int = Field(ge=1, le=40, strict=True)
    rows: int = Field(ge=1, le=40, strict=True)
    square_m: Length
    marker_m: Length
    dictionary: str = Field(default="DICT_5X5_250", pattern=r"^DICT_[A-Z0-9_]{1,32}$")
    first_marker: int = Field(default=0, ge=0, le=1023, strict=True)
    pose: PoseFile = PoseFile()

    @model_validator(mode="after")
    def _marker_fits(self) -> BoardFile:
        if self.marker_m >= self.square_m:
            raise ValueError(f"expected marker_m below square_m = {self.square_m:g}, got {self.marker_m:g}")
        if self.kind == "charuco" and min(self.columns, self.rows) < 2:
            raise ValueError(f"expected a charuco board of at least 2 x 2 squares, got {self.columns} x {self.rows}")
        return self


class CellFile(_Model):
    """All of `cell.yaml`."""

    name: Name
    box: BoxFile
    static: tuple[BodyFile, ...] = Field(default=(), max_length=MAX_BODIES)
    objects: tuple[BodyFile, ...] = Field(default=(), max_length=MAX_BODIES)
    robot: RobotFile | None = None
    board: BoardFile | None = None

    @model_validator(mode="after")
    def _names_once(self) -> CellFile:
        names = [body.name for body in (*self.static, *self.objects)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"expected each name once among static and objects, got {', '.join(twice)} again")
        return self


def read_cell_file(path: str | Path) -> CellFile:
    """Read and check `cell.yaml`; do not open the files that it names.

    Raises:
        CellError: the file is missing or not YAML, or a key is unknown, missing or out of range. The text has one
            sentence for each problem, with the file, the path of the key and the value.
    """
    file = Path(path)
    try:
        text = read_text(file)
    except ValueError as error:
        raise CellError(f"{file}: {error}") from error
    except OSError as error:
        raise CellError(f"{file}: expected a readable cell file, got: {error.strerror}") from error
    try:
        content = parse_yaml(text)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark is not None else ""
        raise CellError(f"{file}: {line}expected YAML, got a syntax error: {error.problem}") from error
    except yaml.YAMLError as error:
        raise CellError(f"{file}: expected YAML, got a syntax error: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise CellError(f"{file}: expected a few levels of nesting, got too many") from error
    if not isinstance(content, dict):
        raise CellError(f"{file}: expected keys and values, got {type(content).__name__}")
    try:
        return CellFile.model_validate(content)
    except ValidationError as error:
        problems = [_sentence(problem) for problem in error.errors()]
        raise CellError("\n".join(f"{file}: {problem}" for problem in problems)) from error


def named_file(cell_file: Path, key: str, text: str) -> Path:
    """Resolve a path in `cell.yaml` to a file.

    The path is relative to `cell_file`, absolute, `$VARIABLE/...` from the environment, or `package:NAME/...` for a
    file inside an installed Python package or distribution. The package is found without importing it.

    Raises:
        CellError: the variable, the package or the file does not exist; the text names the key.
    """
    where = f"{cell_file}: {key}"
    found = _named(cell_file, where, text)
    if not found.is_file():
        raise CellError(f"{where}: expected a file at {found}, found {'a folder' if found.is_dir() else 'none'}")
    return found


def named_folder(cell_file: Path, key: str, text: str) -> Path:
    """Return the folder that a path in `cell.yaml` means, by the rules of `named_file`.

    Raises:
        CellError: the variable or the package is not there, or no such folder is; names the key.
    """
    where = f"{cell_file}: {key}"
    found = _named(cell_file, where, text)
    if not found.is_dir():
        raise CellError(f"{where}: expected a folder at {found}, found {'a file' if found.is_file() else 'none'}")
    return found


def _named(cell_file: Path, where: str, text: str) -> Path:
    if text.startswith("package:"):
        return _in_package(where, text)
    if text.startswith("$"):
        variable, _, rest = text[1:].partition("/")
        variable = variable.removeprefix("{").removesuffix("}")
        if not os.environ.get(variable):
            raise CellError(f"{where}: expected the environment variable {variable} to be set, for {text}")
        return Path(os.environ[variable]) / rest
    return cell_file.parent / text


def _in_package(where: str, text: str) -> Path:
    package, _, rest = text.removeprefix("package:").partition("/")
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    folders = [Path(folder) for folder in (spec.submodule_search_locations or [])] if spec else []
    for folder in folders:
        if (folder / rest).is_file():
            return folder / rest
    try:
        located = Path(str(importlib.metadata.distribution(package).locate_file(rest)))
    except (importlib.metadata.PackageNotFoundError, ValueError) as error:
        if folders:
            return folders[0] / rest
        raise CellError(f"{where}: expected an installed package {package or '(no name)'}, for {text}") from error
    return located


def _sentence(problem: Mapping[str, Any]) -> str:
    """Describe one of pydantic's errors as `key: expected ..., got ...`."""
    key = ""
    for part in problem["loc"]:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else str(part)
    value = problem["input"]
    if problem["type"] == "extra_forbidden":
        allowed = ", ".join(_keys_at(problem["loc"][:-1]))
        return f"{key}: expected a key out of {allowed}, got an unknown one"
    if problem["type"] == "missing":
        return f"{key}: expected a value, got none"
    if problem["type"] == "value_error":
        return f"{key + ': ' if key else ''}{problem['ctx']['error']}"
    shown = repr(value) if isinstance(value, (str, int, float, bool)) else _KINDS.get(type(value), "something else")
    if problem["type"] in ("too_short", "too_long"):
        bound = "at least" if problem["type"] == "too_short" else "at most"
        count = problem["ctx"].get("min_length", problem["ctx"].get("max_length"))
        return f"{key}: expected {bound} {count} entries, got {problem['ctx']['actual_length']}"
    if problem["type"] in _EXPECTED:
        return f"{key}: expected {_EXPECTED[problem['type']].format(**problem.get('ctx', {}))}, got {shown}"
    return f"{key}: expected {str(problem['msg']).removeprefix('Input should be ')}, got {shown}"


_EXPECTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text",
    "finite_number": "a finite number",
    "tuple_type": "a list",
    "dict_type": "keys and values",
    "model_type": "keys and values",
    "string_pattern_mismatch": "text that matches {pattern}",
}
"""Expected value for each of pydantic's error types, in terms of YAML."""

_KINDS = {dict: "keys and values", list: "a list", type(None): "nothing"}


def _keys_at(location: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the file format allows at a location."""
    model: Any = CellFile
    for part in location:
        if isinstance(part, int) or part not in model.model_fields:
            continue
        inner = _model_in(model.model_fields[part].annotation)
        model = model if inner is None else inner
    return list(model.model_fields)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Find the model nested in an annotation such as `tuple[Model, ...] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _model_in(argument)
        if found is not None:
            return found
    return None
