# SPDX-License-Identifier: Apache-2.0
"""A URDF file as plain joints and meshes, each mesh in its link's frame.

The XML is read by ourselves: what a file says and this module does not understand must be refused by name, and the
libraries that read a URDF drop it. Needed where a cell is loaded from its files, not on a unit that is sent one.
"""

from __future__ import annotations

import importlib.util
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast
from urllib.parse import unquote, urlsplit
from xml.dom import expatbuilder, minidom
from xml.parsers.expat import ExpatError

import numpy as np

from shared.errors import InputError, KinematicsError, MeshError
from shared.meshes import (
    TriangleMesh,
    box_mesh,
    capsule_mesh,
    concatenated,
    cylinder_mesh,
    ellipsoid_mesh,
    load_mesh,
    sphere_mesh,
)
from shared.transforms import Transform, from_rotation_translation, from_xyz_rpy

logger = logging.getLogger(__name__)

MeshKind = Literal["collision_or_visual", "collision", "visual"]
JointKind = Literal["revolute", "continuous", "prismatic", "fixed"]

JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed")

QUATERNION_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's length from 1; three decimals of each number leave it off by less."""

NAMES_SHOWN = 10
"""Of links or files in one message; a robot without any mesh file would fill a screen."""


@dataclass(frozen=True, eq=False)
class Mimic:
    """A joint that follows another: `multiplier * position + offset`."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A joint of the file; `T_parent_joint` is its `<origin>`, and `axis` has unit length."""

    name: str
    kind: JointKind
    parent: str
    child: str
    T_parent_joint: Transform
    axis: tuple[float, float, float]
    mimic: Mimic | None


@dataclass(frozen=True, eq=False)
class UrdfModel:
    """A tree of links. `joints` come parents first; `meshes` has the links with a shape, in the file's order.

    `warnings` are sentences about links whose shapes were replaced or passed over.
    """

    name: str
    root: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]
    meshes: Mapping[str, TriangleMesh]
    warnings: tuple[str, ...] = ()


def read_urdf(
    path: str | Path,
    kind: MeshKind = "collision_or_visual",
    packages: Mapping[str, Path] | None = None,
    replaced: Mapping[str, TriangleMesh] | None = None,
) -> UrdfModel:
    """Read a URDF file and the meshes that it names.

    Args:
        path: the file; xacro must have been expanded before.
        kind: which of its shapes to take; `collision_or_visual` takes the visual ones of a link without collision
            shapes, and warns.
        packages: folders of ROS packages, for `package://name/...` and for `file://.../name/...` of another computer.
            Others are sought among the folders above the file, and then among the installed Python packages.
        replaced: meshes (link frame) to take for these links instead of the file's, whose shapes are not read.

    Raises:
        KinematicsError: the file is missing, no URDF, no tree, not expanded, or uses a joint or a shape that is not
            supported; names the link or joint and the attribute.
        MeshError: a mesh that it names is missing or unusable; missing ones are named all at once.
    """
    file = Path(path)
    robot = _parse(file)
    links = tuple(_name(file, element, "link") for element in _children(robot, "link"))
    if not links:
        raise KinematicsError(f"{file}: expected a robot with links, got none")
    joints = tuple(_joint(file, element, links) for element in _children(robot, "joint"))
    root, ordered = _tree(file, links, joints)
    unknown = sorted(set(replaced or {}) - set(links))
    if unknown:
        raise KinematicsError(f"{file}: expected links of {', '.join(links)}, got {', '.join(unknown)}")
    shapes = _Shapes(file, kind, packages or {}, replaced or {})
    meshes = {name: mesh for name, mesh in shapes.of_links(_children(robot, "link"))}
    warnings = shapes.warnings()
    for warning in warnings:
        logger.warning("%s: %s", file, warning)
    return UrdfModel(robot.getAttribute("name") or file.stem, root, links, ordered, meshes, warnings)


def _parse(file: Path) -> minidom.Element:
    """The `<robot>` of a file, without other tools' elements."""
    try:
        # Without namespaces: existing files use prefixes that they never declare.
        document = expatbuilder.parse(str(file), namespaces=False)
    except OSError as error:
        raise KinematicsError(f"{file}: expected a readable URDF file, got {error.strerror}") from error
    except ExpatError as error:
        raise KinematicsError(f"{file}: expected a URDF file, got malformed XML: {error}") from error
    # Valid XML in an encoding that Python does not know, or with a character that is none.
    except (ValueError, LookupError) as error:
        raise KinematicsError(f"{file}: expected a URDF file, got XML that cannot be decoded: {error}") from error
    top = document.documentElement
    if top is None or top.tagName != "robot":
        raise KinematicsError(f"{file}: expected <robot> as the outermost element, got <{top and top.tagName}>")
    _refuse_xacro(file, top, top)
    return top


def _refuse_xacro(file: Path, element: minidom.Element, inside: minidom.Element) -> None:
    """Refuse what an expanded file does not have; `inside` is the named element around, for the message."""
    where = f"{inside.tagName} {inside.getAttribute('name')}".strip()
    found = [element.tagName] if element.tagName.startswith("xacro:") else []
    for attribute, value in element.attributes.items():
        found += [f'{attribute}="{value}"'] if "${" in value or "$(" in value else []
    if found:
        raise KinematicsError(
            f"{file}: {where}: expected a URDF, got xacro that was not expanded ({found[0]}); expand xacro first: "
            f"xacro {file.name} > expanded.urdf"
        )
    for child in _children(element):
        _refuse_xacro(file, child, child if child.tagName in ("link", "joint") else inside)


def _children(element: minidom.Element, *tags: str) -> list[minidom.Element]:
    """The elements directly inside, all or those of some tags."""
    inside = [child for child in element.childNodes if isinstance(child, minidom.Element)]
    return [child for child in inside if not tags or child.tagName in tags]


def _only(where: str, element: minidom.Element, tag: str) -> minidom.Element | None:
    """The one element of a tag inside, None where there is none."""
    found = _children(element, tag)
    if len(found) > 1:
        raise KinematicsError(f"{where}: expected one <{tag}>, got {len(found)}")
    return found[0] if found else None


def _name(file: Path, element: minidom.Element, what: str) -> str:
    name = element.getAttribute("name")
    if not name:
        raise KinematicsError(f"{file}: expected every {what} to have a name, got one without")
    return name


def _numbers(
    where: str, element: minidom.Element, attribute: str, count: int | tuple[int, ...], default: Sequence[float] | None
) -> tuple[float, ...]:
    """The finite numbers of an attribute, as many as `count`; `default` where it is absent, None if it must not be."""
    counts = count if isinstance(count, tuple) else (count,)
    if not element.hasAttribute(attribute):
        if default is None:
            raise KinematicsError(f"{where}: expected <{element.tagName}> with {attribute}, got none")
        return tuple(default)
    text = element.getAttribute(attribute)
    try:
        numbers = tuple(float(word) for word in text.split())
    except ValueError:
        numbers = ()
    if len(numbers) not in counts or not all(math.isfinite(number) for number in numbers):
        wanted = " or ".join("one number" if n == 1 else f"{n} numbers" for n in counts)
        raise KinematicsError(f"{where}: {element.tagName} {attribute}: expected {wanted}, got {text[:60]!r}")
    return numbers


def _joint(file: Path, element: minidom.Element, links: tuple[str, ...]) -> UrdfJoint:
    name = _name(file, element, "joint")
    where = f"{file}: joint {name}"
    kind = element.getAttribute("type")
    if kind not in JOINT_TYPES:
        raise KinematicsError(f"{where}: expected a type of {', '.join(JOINT_TYPES)}, got {kind or 'none'}")
    ends = []
    for role in ("parent", "child"):
        end = _only(where, element, role)
        link = "" if end is None else end.getAttribute("link")
        if link not in links:
            raise KinematicsError(f"{where}: expected a {role} that is a link of the file, got {link or 'none'}")
        ends.append(link)
    axis = _only(where, element, "axis")
    direction = np.array((1.0, 0.0, 0.0) if axis is None else _numbers(where, axis, "xyz", 3, None))
    length = float(np.linalg.norm(direction))
    if kind != "fixed" and not length > 0.0:
        raise KinematicsError(f"{where}: expected an axis of three numbers, not all zero, got {direction.tolist()}")
    x, y, z = direction / length if length > 0.0 else (0.0, 0.0, 1.0)
    follows = _only(where, element, "mimic")
    mimic = None
    if follows is not None and kind != "fixed":
        (multiplier,) = _numbers(where, follows, "multiplier", 1, (1.0,))
        (offset,) = _numbers(where, follows, "offset", 1, (0.0,))
        mimic = Mimic(follows.getAttribute("joint"), multiplier, offset)
    parent, child = ends
    return UrdfJoint(
        name, cast(JointKind, kind), parent, child, _origin(where, element), (float(x), float(y), float(z)), mimic
    )


def _origin(where: str, element: minidom.Element) -> Transform:
    """`T_parent_this` of an element's `<origin>`; the rotation is `rpy` or, since URDF 1.1, `quat_xyzw`."""
    origin = _only(where, element, "origin")
    if origin is None:
        return np.eye(4)
    xyz = _numbers(where, origin, "xyz", 3, (0.0, 0.0, 0.0))
    if not origin.hasAttribute("quat_xyzw"):
        return from_xyz_rpy(xyz, _numbers(where, origin, "rpy", 3, (0.0, 0.0, 0.0)))
    if origin.hasAttribute("rpy"):
        raise KinematicsError(f"{where}: origin: expected rpy or quat_xyzw, got both")
    quaternion = np.array(_numbers(where, origin, "quat_xyzw", 4, None))
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise KinematicsError(f"{where}: origin quat_xyzw: expected a quaternion of length 1, got one of {length:.4g}")
    x, y, z, w = quaternion / length
    rotation = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return from_rotation_translation(rotation, xyz)


def _tree(file: Path, links: tuple[str, ...], joints: tuple[UrdfJoint, ...]) -> tuple[str, tuple[UrdfJoint, ...]]:
    """Return the root link, and the joints in chain order: depth first, siblings in the file's order."""
    for what, names in (("link", links), ("joint", [joint.name for joint in joints])):
        twice = sorted({name for name in names if list(names).count(name) > 1})
        if twice:
            raise KinematicsError(f"{file}: expected each {what} once, got {', '.join(twice)} more than once")
    children = [joint.child for joint in joints]
    for joint in joints:
        if children.count(joint.child) > 1:
            raise KinematicsError(f"{file}: expected one joint to hold link {joint.child}, got several")
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        raise KinematicsError(f"{file}: expected one link that is no joint's child, got {', '.join(roots) or 'none'}")
    ordered: list[UrdfJoint] = []
    pending = [joint for joint in reversed(joints) if joint.parent == roots[0]]
    while pending:
        joint = pending.pop()
        ordered.append(joint)
        pending.extend(other for other in reversed(joints) if other.parent == joint.child)
    if len(ordered) != len(joints):
        lost = sorted({joint.name for joint in joints} - {joint.name for joint in ordered})
        raise KinematicsError(f"{file}: expected all joints below {roots[0]}, got a ring of {', '.join(lost)}")
    return roots[0], tuple(ordered)


@dataclass
class _Shapes:
    """The shapes of a file's links, and what there is to say of them at the end."""

    file: Path
    kind: MeshKind
    packages: Mapping[str, Path]
    replaced: Mapping[str, TriangleMesh]
    visual_only: list[str] = field(default_factory=list)
    unfiltered: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    packages_used: set[str] = field(default_factory=set)

    def of_links(self, links: Sequence[minidom.Element]) -> Iterator[tuple[str, TriangleMesh]]:
        """Each link that has a shape, with one mesh in its frame.

        Raises:
            KinematicsError, MeshError: as `read_urdf`.
        """
        for link in links:
            name = link.getAttribute("name")
            if name in self.replaced:
                yield name, self.replaced[name]
                continue
            parts = self._parts(name, link)
            if parts:
                yield name, concatenated(name, parts)
        if self.missing:
            raise MeshError(
                f"{self.file}: expected these mesh files, got nothing there: {_listed(self.missing)}; name the folders "
                "of ROS packages under `packages`"
            )

    def warnings(self) -> tuple[str, ...]:
        """Sentences about what the filter will not do as the file's author may expect."""
        unused = sorted(set(self.packages) - self.packages_used)
        found = (
            (self.visual_only, "links without a collision shape, whose visual shape is filtered instead: {}"),
            (self.unfiltered, "links without a collision shape, which are reported as obstacles: {}"),
            (self.empty, "shapes without a size, which are passed over: {}"),
            (unused, "names under packages that no mesh of the file uses: {}"),
        )
        return tuple(sentence.format(_listed(names)) for names, sentence in found if names)

    def _parts(self, name: str, link: minidom.Element) -> list[TriangleMesh]:
        """The meshes of a link, link frame."""
        collisions, visuals = _children(link, "collision"), _children(link, "visual")
        chosen = visuals if self.kind == "visual" else collisions
        problems = len(self.missing)
        parts = self._meshes(name, chosen)
        if not parts and visuals and self.kind == "collision_or_visual" and len(self.missing) == problems:
            chosen = visuals
            if parts := self._meshes(name, visuals):
                self.visual_only.append(name)
        if not parts and visuals and not collisions and self.kind == "collision":
            self.unfiltered.append(name)
        # Of no size, nothing can be filtered; without a word of its shape, nobody knows what is not.
        if not parts and any(_is_empty(element) for element in chosen):
            raise KinematicsError(
                f"{self.file}: link {name}: expected a shape in its <geometry>, got none; give it one under "
                f"`link_meshes`, or take its <{chosen[0].tagName}> out of the file"
            )
        return parts

    def _meshes(self, name: str, elements: Sequence[minidom.Element]) -> list[TriangleMesh]:
        return [mesh for element in elements if (mesh := self._shape(name, element)) is not None]

    def _shape(self, link: str, element: minidom.Element) -> TriangleMesh | None:
        """One `<collision>` or `<visual>` in the link's frame; None where it has no size or its file is missing."""
        where = f"{self.file}: link {link}"
        geometry = _only(where, element, "geometry")
        if geometry is None:
            raise KinematicsError(f"{where}: expected a <geometry> in <{element.tagName}>, got none")
        T_link_shape = _origin(where, element)
        shapes = _children(geometry)
        if not shapes:
            self.empty.append(f"{link} (<geometry>)")
            return None
        if len(shapes) > 1:
            found = ", ".join(f"<{shape.tagName}>" for shape in shapes)
            raise KinematicsError(f"{where}: expected one shape in a <geometry>, got {found}")
        (shape,) = shapes
        tag = shape.tagName.removeprefix("drake:")
        try:
            if tag == "mesh":
                mesh = self._mesh(where, link, shape)
            elif tag in _PRIMITIVES:
                mesh = self._primitive(where, link, shape, tag)
            else:
                raise KinematicsError(
                    f"{where}: expected a shape of mesh, {', '.join(_PRIMITIVES)}, got <{shape.tagName}>; "
                    f"give link {link} another shape under `link_meshes`"
                )
            return None if mesh is None else mesh.transformed(T_link_shape)
        except (MeshError, InputError) as error:
            raise MeshError(f"{where}: {error}") from error

    def _primitive(self, where: str, link: str, shape: minidom.Element, tag: str) -> TriangleMesh | None:
        sizes, make = _PRIMITIVES[tag]
        by_axis = tag == "ellipsoid" and shape.hasAttribute("a")
        wanted = (("a", 1), ("b", 1), ("c", 1)) if by_axis else sizes
        numbers = [number for name, count in wanted for number in _numbers(where, shape, name, count, None)]
        if by_axis:
            numbers = [2.0 * number for number in numbers]
        if min(numbers) < 0.0:
            raise KinematicsError(f"{where}: {shape.tagName}: expected sizes above 0, got {numbers}")
        # A capsule of no length is a sphere; any other shape of no size bounds nothing.
        if numbers[0] == 0.0 or (tag != "capsule" and min(numbers) == 0.0):
            self.empty.append(f"{link} (<{shape.tagName}>)")
            return None
        return make(link, numbers)

    def _mesh(self, where: str, link: str, shape: minidom.Element) -> TriangleMesh | None:
        uri = shape.getAttribute("filename")
        if not uri:
            raise KinematicsError(f"{where}: expected a mesh with a filename, got none")
        scale = _numbers(where, shape, "scale", (1, 3), (1.0,))
        found = self._found(uri)
        if found is None:
            self.missing.append(f"{uri} (link {link})")
            return None
        return load_mesh(found, scale if len(scale) == 3 else scale[0], link)

    def _found(self, uri: str) -> Path | None:
        """The file that a mesh's name means: relative to the URDF, absolute, `file://` or `package://`."""
        if uri.startswith("package://"):
            package, _, rest = uri.removeprefix("package://").partition("/")
            return self._in_package(package, rest)
        path = Path(unquote(urlsplit(uri).path)) if uri.startswith("file://") else self.file.parent / uri
        if path.is_file():
            return path
        # A path of the computer on which the file was made: its packages may lie elsewhere here.
        for index, part in enumerate(path.parts):
            if part in self.packages and (found := self._in_package(part, str(Path(*path.parts[index + 1 :])))):
                return found
        return None

    def _in_package(self, package: str, rest: str) -> Path | None:
        if package in self.packages:
            self.packages_used.add(package)
            found = Path(self.packages[package]) / rest
            return found if found.is_file() else None
        for folder in self.file.absolute().parents:
            if (folder / package / rest).is_file():
                return folder / package / rest
        installed = importlib.util.find_spec(package) if package.isidentifier() else None
        for place in (installed.submodule_search_locations or []) if installed else []:
            if (Path(place) / rest).is_file():
                return Path(place) / rest
        return None


_PRIMITIVES: Mapping[str, tuple[tuple[tuple[str, int], ...], Callable[[str, list[float]], TriangleMesh]]] = {
    "box": ((("size", 3),), lambda name, size: box_mesh(name, size)),
    "cylinder": ((("radius", 1), ("length", 1)), lambda name, size: cylinder_mesh(name, size[0], size[1])),
    "sphere": ((("radius", 1),), lambda name, size: sphere_mesh(name, size[0])),
    "capsule": ((("radius", 1), ("length", 1)), lambda name, size: capsule_mesh(name, size[0], size[1])),
    "ellipsoid": ((("size", 3),), lambda name, size: ellipsoid_mesh(name, size)),
}
"""Attributes of each shape with the count of their numbers, and the mesh of those numbers in metres."""


def _is_empty(element: minidom.Element) -> bool:
    """Return True for a `<collision>` or `<visual>` whose `<geometry>` holds no shape."""
    return not any(_children(geometry) for geometry in _children(element, "geometry"))


def _listed(names: Sequence[str]) -> str:
    further = len(names) - NAMES_SHOWN
    return ", ".join(names[:NAMES_SHOWN]) + (f" and {further} more" if further > 0 else "")
