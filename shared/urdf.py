# SPDX-License-Identifier: Apache-2.0
"""A URDF file as plain joints and meshes, each mesh in its link's frame.

yourdfpy reads the file. It is needed only to load a cell from files, not on a unit that receives its cell. Our own code
finds and reads meshes, so that a missing mesh is an error instead of a warning.
"""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote, urlsplit
from xml.dom import expatbuilder, minidom
from xml.parsers.expat import ExpatError

import numpy as np

from shared.errors import KinematicsError, MeshError
from shared.meshes import TriangleMesh, box_mesh, concatenated, cylinder_mesh, load_mesh, sphere_mesh
from shared.transforms import Transform, identity, validated

MeshKind = Literal["collision", "visual"]

JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed")


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
    kind: Literal["revolute", "continuous", "prismatic", "fixed"]
    parent: str
    child: str
    T_parent_joint: Transform
    axis: tuple[float, float, float]
    mimic: Mimic | None


@dataclass(frozen=True, eq=False)
class UrdfModel:
    """A tree of links. `joints` has parents first; `meshes` has the links with a shape, in the file's order."""

    name: str
    root: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]
    meshes: Mapping[str, TriangleMesh]


def read_urdf(
    path: str | Path,
    kind: MeshKind = "collision",
    packages: Mapping[str, Path] | None = None,
    replaced: Mapping[str, TriangleMesh] | None = None,
) -> UrdfModel:
    """Read a URDF file and the meshes that it names.

    Args:
        path: the file; expand xacro beforehand.
        kind: the shapes of the file to use.
        packages: folders of ROS packages for `package://name/...`. Other packages are searched for in the folders
            above the file, then among the installed Python packages.
        replaced: meshes (link frame) that replace the file's for these links.

    Raises:
        KinematicsError: the file is missing, is not a URDF or not a tree, or uses an unsupported joint.
        MeshError: a mesh of the file is missing or unusable.
    """
    file = Path(path)
    robot = _parse(file)
    links = tuple(link.name for link in robot.links)
    joints = tuple(_joint(file, joint, links) for joint in robot.joints)
    root, ordered = _tree(file, links, joints)
    unknown = sorted(set(replaced or {}) - set(links))
    if unknown:
        raise KinematicsError(f"{file}: expected links of {', '.join(links)}, got {', '.join(unknown)}")
    meshes: dict[str, TriangleMesh] = {}
    for link in robot.links:
        if replaced and link.name in replaced:
            meshes[link.name] = replaced[link.name]
            continue
        parts = [
            _shape(file, link.name, element, packages or {})
            for element in (link.collisions if kind == "collision" else link.visuals)
        ]
        if parts:
            meshes[link.name] = concatenated(link.name, parts)
    return UrdfModel(str(robot.name), root, links, ordered, meshes)


def _parse(file: Path) -> Any:
    """Parse the file into yourdfpy's robot, after checking that the XML is complete."""
    try:
        import yourdfpy
    except ImportError as error:
        raise KinematicsError(f"{file}: expected yourdfpy to read a URDF, got no such package installed") from error
    try:
        # Without namespaces: existing files use prefixes that they never declare.
        document = expatbuilder.parse(str(file), namespaces=False)
    except OSError as error:
        raise KinematicsError(f"{file}: expected a readable URDF file, got {error.strerror}") from error
    except ExpatError as error:
        raise KinematicsError(f"{file}: expected a URDF file, got malformed XML: {error}") from error
    top = document.documentElement
    if top is None or top.tagName != "robot":
        raise KinematicsError(f"{file}: expected <robot> as the outermost element, got <{top and top.tagName}>")
    if not top.getAttribute("name"):
        top.setAttribute("name", file.stem)
    _drop_prefixed(top)
    try:
        model = yourdfpy.URDF.load(
            io.BytesIO(document.toxml(encoding="utf-8")),
            build_scene_graph=False,
            load_meshes=False,
        )
    # yourdfpy checks little, so a damaged file can raise any error.
    except Exception as error:
        raise KinematicsError(f"{file}: expected a URDF file, got {type(error).__name__}: {error}") from error
    if not model.robot.links:
        raise KinematicsError(f"{file}: expected a robot with links, got none")
    return model.robot


def _drop_prefixed(element: minidom.Element) -> None:
    """Remove elements and attributes of other tools (`drake:...`), which are not part of a URDF."""
    for name in list(element.attributes.keys()):
        if ":" in name:
            element.removeAttribute(name)
    for child in list(element.childNodes):
        if isinstance(child, minidom.Element):
            if ":" in child.tagName:
                element.removeChild(child)
            else:
                _drop_prefixed(child)


def _joint(file: Path, joint: Any, links: tuple[str, ...]) -> UrdfJoint:
    where = f"{file}: joint {joint.name}"
    if joint.type not in JOINT_TYPES:
        raise KinematicsError(f"{where}: expected a type of {', '.join(JOINT_TYPES)}, got {joint.type}")
    for role, link in (("parent", joint.parent), ("child", joint.child)):
        if link not in links:
            raise KinematicsError(f"{where}: expected a {role} that is a link of the file, got {link}")
    axis = np.asarray(joint.axis, dtype=np.float64)
    length = float(np.linalg.norm(axis)) if axis.shape == (3,) else 0.0
    if joint.type != "fixed" and not (np.isfinite(length) and length > 0.0):
        raise KinematicsError(f"{where}: expected an axis of three numbers, not all zero, got {axis.tolist()}")
    x, y, z = axis / length if length > 0.0 else (0.0, 0.0, 1.0)
    mimic = None
    if joint.mimic is not None and joint.type != "fixed":
        multiplier = 1.0 if joint.mimic.multiplier is None else float(joint.mimic.multiplier)
        offset = 0.0 if joint.mimic.offset is None else float(joint.mimic.offset)
        mimic = Mimic(joint.mimic.joint, multiplier, offset)
    return UrdfJoint(
        joint.name,
        joint.type,
        joint.parent,
        joint.child,
        _origin(where, joint.origin),
        (float(x), float(y), float(z)),
        mimic,
    )


def _origin(where: str, origin: Any) -> Transform:
    try:
        return identity() if origin is None else validated(origin, "origin")
    except ValueError as error:
        raise KinematicsError(f"{where}: {error}") from error


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


def _shape(file: Path, link: str, element: Any, packages: Mapping[str, Path]) -> TriangleMesh:
    """Return the mesh of one `<collision>` or `<visual>` in the link's frame."""
    where = f"{file}: link {link}"
    geometry = element.geometry
    try:
        if geometry is None:
            raise KinematicsError(f"{where}: expected a <geometry>, got none")
        if geometry.mesh is not None:
            scale = [1.0] if geometry.mesh.scale is None else np.atleast_1d(geometry.mesh.scale).tolist()
            source = _mesh_file(file, link, geometry.mesh.filename, packages)
            mesh = load_mesh(source, scale if len(scale) > 1 else scale[0], link)
        elif geometry.box is not None:
            mesh = box_mesh(link, geometry.box.size)
        elif geometry.cylinder is not None:
            mesh = cylinder_mesh(link, geometry.cylinder.radius, geometry.cylinder.length)
        else:
            mesh = sphere_mesh(link, geometry.sphere.radius)
    except MeshError as error:
        raise MeshError(f"{where}: {error}") from error
    return mesh.transformed(_origin(where, element.origin))


def _mesh_file(file: Path, link: str, uri: str | None, packages: Mapping[str, Path]) -> Path:
    """Resolve `<mesh filename>` to a file: relative to the URDF, absolute, `file://` or `package://`."""
    if not uri:
        raise KinematicsError(f"{file}: link {link}: expected a mesh with a filename, got none")
    if uri.startswith("file://"):
        return Path(unquote(urlsplit(uri).path))
    if not uri.startswith("package://"):
        return file.parent / uri
    package, _, rest = uri.removeprefix("package://").partition("/")
    if package in packages:
        return Path(packages[package]) / rest
    for folder in file.absolute().parents:
        if (folder / package / rest).is_file():
            return folder / package / rest
    installed = importlib.util.find_spec(package) if package.isidentifier() else None
    for place in (installed.submodule_search_locations or []) if installed else []:
        if (Path(place) / rest).is_file():
            return Path(place) / rest
    raise KinematicsError(
        f"{file}: link {link}: expected to find {uri}, got no folder {package} with it above the file "
        f"nor an installed package; name its folder under `packages`"
    )
