# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes of CAD and robot links, from which surfaces are rendered.

A mesh is *closed* when its surface bounds a volume and its triangles face outwards (counter-clockwise from outside).
Only then may a renderer skip the triangles that it sees from behind. A mesh that is not closed is kept unchanged and
rendered from both sides.
"""

from __future__ import annotations

import hashlib
import io
import logging
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.errors import MeshError
from shared.transforms import Transform

logger = logging.getLogger(__name__)

MAX_TRIANGLES = 1_000_000
"""Limit of triangles: 18 MB of canonical bytes and about a second to render on a unit; finer CAD is a mistake."""

FILE_SUFFIXES = (".stl", ".obj", ".dae", ".ply", ".glb")

MERGE_DISTANCE_M = 1e-6
"""Distance below which vertices are merged; STL repeats each vertex in every triangle that uses it."""

MIN_TRIANGLE_AREA_M2 = 1e-12
"""Least area of a triangle: a square micrometre covers no pixel and has no usable normal."""

MAX_COORDINATE_M = 1000.0
"""Limit of coordinates. No cell is a kilometre wide: larger values mean a file in millimetres without its `scale`."""

_STL_HEADER_BYTES, _STL_TRIANGLE_BYTES = 84, 50
"""Of a binary STL: 80 bytes of text and the count of triangles; three corners, a normal and two bytes for each."""

_STL_PROBE_BYTES = 1024
"""From the start of an STL: enough for the first facet of one in ASCII."""

_LFS_POINTER = b"version https://git-lfs"
"""The start of the text that stands where Git LFS has not fetched a file."""

CIRCLE_SEGMENTS = 48
"""Segments of a circle: a cylinder of 0.1 m radius is then at most 0.2 mm inside the true surface."""

_BOX_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_BOX_FACES = np.array((
    (1, 3, 0), (4, 1, 0), (0, 3, 2), (2, 4, 0), (1, 7, 3), (5, 1, 4),
    (5, 7, 1), (3, 7, 2), (6, 4, 2), (2, 7, 6), (6, 5, 4), (7, 5, 6),
))  # fmt: skip
"""Corners and faces of a box, written out: the warm-up of a unit uses boxes without importing trimesh."""

_HEADER = struct.Struct("<4sIII")
_MAGIC = b"CWM1"


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles in metres. The arrays are read-only.

    Attributes:
        name: a name for messages; not part of the canonical bytes.
        vertices: (V, 3) float32, metres, mesh frame.
        faces: (F, 3) int32, indices into `vertices`.
        closed: it bounds a volume and all its triangles face outwards, into a hollow inside as well.
    """

    name: str
    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    closed: bool

    def __post_init__(self) -> None:
        with np.errstate(over="ignore"):
            vertices = np.array(self.vertices, dtype=np.float32, order="C")
        faces = np.array(self.faces, dtype=np.int32, order="C")
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise MeshError(
                f"mesh {self.name}: expected vertices (V, 3) and faces (F, 3), got {vertices.shape} and {faces.shape}"
            )
        if not len(faces):
            raise MeshError(f"mesh {self.name}: expected at least one triangle, got none")
        if len(faces) > MAX_TRIANGLES or len(vertices) > 3 * MAX_TRIANGLES:
            raise MeshError(f"mesh {self.name}: expected at most {MAX_TRIANGLES} triangles, got {len(faces)}")
        if not np.isfinite(vertices).all():
            raise MeshError(f"mesh {self.name}: expected finite coordinates, got NaN or infinity")
        farthest = float(np.abs(vertices).max(initial=0.0))
        if farthest > MAX_COORDINATE_M:
            raise MeshError(
                f"mesh {self.name}: expected coordinates within {MAX_COORDINATE_M:g} m, "
                f"got {farthest:.4g} m; for a file in millimetres set scale 0.001"
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise MeshError(
                f"mesh {self.name}: expected face indices of 0 to {len(vertices) - 1}, "
                f"got {faces.min()} to {faces.max()}"
            )
        vertices.flags.writeable = False
        faces.flags.writeable = False
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @classmethod
    def of_triangles(cls, name: str, vertices: NDArray[Any], faces: NDArray[Any]) -> TriangleMesh:
        """Build a mesh from raw triangles: merge vertices, drop flat triangles, determine `closed`.

        Args:
            name: a name for messages.
            vertices: (V, 3) metres, any float dtype.
            faces: (F, 3) indices into `vertices`.

        Raises:
            MeshError: no triangle is left, or a number is not finite or out of range.
        """
        raw = cls(name, np.asarray(vertices), np.asarray(faces), closed=False)
        merged, corner = _merge_vertices(raw.vertices)
        triangles = corner[raw.faces]
        # Before flat triangles are dropped: a flat one may be the only connection between two neighbours.
        closed = _bounds_volume(triangles)
        points = merged.astype(np.float64)
        if closed:
            triangles, closed = _face_outwards(points, triangles)
        a, b, c = points[triangles[:, 0]], points[triangles[:, 1]], points[triangles[:, 2]]
        areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        triangles = triangles[areas > MIN_TRIANGLE_AREA_M2]
        if not len(triangles):
            raise MeshError(f"mesh {name}: expected triangles with an area, got {len(areas)} without")
        used, compact = np.unique(triangles, return_inverse=True)
        return cls(name, merged[used], compact.reshape(-1, 3).astype(np.int32), closed)

    @cached_property
    def bounds_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner (3,) of the bounding box, metres, mesh frame."""
        points = self.vertices.astype(np.float64)
        return points.min(axis=0), points.max(axis=0)

    @cached_property
    def sha256(self) -> str:
        """Hash of the canonical bytes as hex: equal geometry has an equal hash."""
        return hashlib.sha256(self.to_bytes()).hexdigest()

    def to_bytes(self) -> bytes:
        """Return the canonical bytes: a header of `CWM1`, closed, V, F (little-endian), then vertices and faces."""
        return b"".join(
            (
                _HEADER.pack(_MAGIC, int(self.closed), len(self.vertices), len(self.faces)),
                self.vertices.astype("<f4").tobytes(),
                self.faces.astype("<i4").tobytes(),
            )
        )

    @classmethod
    def from_bytes(cls, data: bytes, name: str) -> TriangleMesh:
        """Read canonical bytes that came over the network.

        Raises:
            MeshError: the bytes are not a mesh, cut off or too many, or hold an index or number out of range.
        """
        if len(data) < _HEADER.size:
            raise MeshError(f"mesh {name}: expected at least {_HEADER.size} bytes, got {len(data)}")
        magic, closed, vertex_count, face_count = _HEADER.unpack_from(data)
        if magic != _MAGIC or closed not in (0, 1):
            raise MeshError(f"mesh {name}: expected bytes that begin with {_MAGIC!r}, got {data[:8]!r}")
        if vertex_count > 3 * MAX_TRIANGLES or face_count > MAX_TRIANGLES:
            raise MeshError(f"mesh {name}: expected at most {MAX_TRIANGLES} triangles, got {face_count}")
        expected = _HEADER.size + 12 * vertex_count + 12 * face_count
        if len(data) != expected:
            raise MeshError(f"mesh {name}: expected {expected} bytes by its header, got {len(data)}")
        vertices = np.frombuffer(data, "<f4", 3 * vertex_count, _HEADER.size).reshape(-1, 3)
        faces = np.frombuffer(data, "<i4", 3 * face_count, _HEADER.size + 12 * vertex_count).reshape(-1, 3)
        return cls(name, vertices, faces, bool(closed))

    def transformed(self, T_new_mesh: Transform) -> TriangleMesh:
        """Return the same triangles in another frame."""
        points = self.vertices.astype(np.float64) @ T_new_mesh[:3, :3].T + T_new_mesh[:3, 3]
        return TriangleMesh(self.name, points.astype(np.float32), self.faces, self.closed)


def concatenated(name: str, meshes: list[TriangleMesh]) -> TriangleMesh:
    """Join meshes of one frame; closed when all of them are. Vertices of different meshes are not merged."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return TriangleMesh(
        name,
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        all(mesh.closed for mesh in meshes),
    )


def load_mesh(path: str | Path, scale: float | Sequence[float] = 1.0, name: str | None = None) -> TriangleMesh:
    """Read an STL, OBJ, DAE, PLY or GLB file.

    The parts of a scene become one mesh by their own transforms. COLLADA's unit of length is applied and its up axis
    ignored, as RViz does.

    Args:
        path: the file.
        scale: metres per unit of the file, one number or one for each axis (0.001 for a file in millimetres).
        name: a name for messages; the file's stem when None.

    Raises:
        MeshError: the file is missing, unreadable, of another kind, or has no usable triangle; the text names the file.
    """
    file = Path(path)
    factors = np.asarray(scale, dtype=np.float64)
    if factors.shape not in ((), (3,)) or not np.isfinite(factors).all() or not factors.all():
        raise MeshError(f"{file}: expected a scale of one or three numbers other than 0, got {scale}")
    if file.suffix.lower() not in FILE_SUFFIXES:
        raise MeshError(f"{file}: expected a mesh file ({', '.join(FILE_SUFFIXES)}), got {file.suffix or file.name!r}")
    if not file.is_file():
        raise MeshError(f"{file}: expected a mesh file, got {'a folder' if file.is_dir() else 'no such file'}")
    try:
        with file.open("rb") as opened:
            start = opened.read(len(_LFS_POINTER))
    except OSError as error:
        raise MeshError(f"{file}: expected a readable mesh file, got {error.strerror}") from error
    if start == _LFS_POINTER:
        raise MeshError(f"{file}: expected a mesh, got a Git LFS pointer to one; fetch it with `git lfs pull`")
    vertices, faces = _read_triangles(file)
    if not len(faces):
        raise MeshError(f"{file}: expected a mesh with triangles, got none: the file is empty or damaged")
    if np.prod(np.broadcast_to(factors, 3)) < 0.0:
        # Mirroring turns a solid inside out; reversing its triangles turns it back.
        faces = faces[:, ::-1]
    try:
        return TriangleMesh.of_triangles(name or file.stem, vertices * factors, faces)
    except MeshError as error:
        raise MeshError(f"{file}: {error}") from error


def mesh_by_hash(meshes: Mapping[str, bytes | TriangleMesh], sha256: str, name: str) -> TriangleMesh:
    """Return the mesh `name` from canonical bytes, or meshes already read, keyed by their hashes.

    Raises:
        MeshError: the mesh is missing, or its bytes are malformed or have another hash.
    """
    if sha256 not in meshes:
        raise MeshError(f"mesh {name}: expected bytes with sha256 {sha256}, got none")
    found = meshes[sha256]
    mesh = found if isinstance(found, TriangleMesh) else TriangleMesh.from_bytes(found, name)
    if mesh.sha256 != sha256:
        raise MeshError(f"mesh {name}: expected bytes with sha256 {sha256}, got {mesh.sha256}")
    return mesh


def box_mesh(name: str, size_m: ArrayLike) -> TriangleMesh:
    """Return a box centred at the origin with edges `size_m` (3,)."""
    return TriangleMesh.of_triangles(name, _BOX_CORNERS * np.asarray(size_m, dtype=np.float64), _BOX_FACES)


def cylinder_mesh(name: str, radius_m: float, length_m: float) -> TriangleMesh:
    """Return a cylinder along z, centred at the origin."""
    return _primitive(name, "cylinder", radius=radius_m, height=length_m, sections=CIRCLE_SEGMENTS)


def sphere_mesh(name: str, radius_m: float) -> TriangleMesh:
    """Return a sphere centred at the origin."""
    return _primitive(name, "icosphere", subdivisions=3, radius=radius_m)


def capsule_mesh(name: str, radius_m: float, length_m: float) -> TriangleMesh:
    """A cylinder of `length_m` about the origin along z with half a sphere on each end."""
    counts = (CIRCLE_SEGMENTS // 2, CIRCLE_SEGMENTS)
    return _primitive(name, "capsule", radius=radius_m, height=length_m, count=counts)


def ellipsoid_mesh(name: str, size_m: ArrayLike) -> TriangleMesh:
    """An ellipsoid about the origin, `size_m` (3,) its diameters."""
    sphere = sphere_mesh(name, 0.5)
    return TriangleMesh.of_triangles(name, sphere.vertices * np.asarray(size_m, dtype=np.float64), sphere.faces)


def _primitive(name: str, kind: str, **sizes: Any) -> TriangleMesh:
    import trimesh

    shape = getattr(trimesh.creation, kind)(**sizes)
    return TriangleMesh.of_triangles(name, np.asarray(shape.vertices), np.asarray(shape.faces))


def _read_triangles(file: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices and faces of all parts of a file, in the file's unit of length (COLLADA: metres)."""
    # The import takes half a second; a unit, which receives its meshes as bytes, does not need it.
    import trimesh

    try:
        content = _stl_content(file) if file.suffix.lower() == ".stl" else None
        source = file if content is None else io.BytesIO(content)
        scene = trimesh.load_scene(source, file_type=file.suffix.lower()[1:], process=False, skip_materials=True)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
        is_collada = file.suffix.lower() == ".dae"
        unit_m = trimesh.units.unit_conversion(scene.units, "meters") if is_collada and scene.units else 1.0
    except MeshError:
        raise
    # The readers raise whatever the damage happens to lead to: struct, index, value, XML and import errors.
    except Exception as error:
        raise MeshError(f"{file}: expected a readable mesh, got {type(error).__name__}: {error}") from error
    vertices = [np.asarray(part.vertices, dtype=np.float64) * unit_m for part in parts]
    faces = [np.asarray(part.faces, dtype=np.int64) for part in parts]
    starts = np.cumsum([0] + [len(points) for points in vertices])
    if not parts:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    return np.concatenate(vertices), np.concatenate([part + starts[i] for i, part in enumerate(faces)])


def _stl_content(file: Path) -> bytes | None:
    """The bytes of a binary STL as far as its header counts, None of one in ASCII.

    Raises:
        MeshError: it is shorter than its header says.
        OSError: it cannot be read.
    """
    content = file.read_bytes()
    # Binary headers may begin with "solid", too; only text goes on with a facet.
    text = content[:_STL_PROBE_BYTES].lower()
    if text.lstrip().startswith(b"solid") and (b"facet" in text or b"endsolid" in text):
        return None
    if len(content) < _STL_HEADER_BYTES:
        raise MeshError(f"{file}: expected an STL file of at least {_STL_HEADER_BYTES} bytes, got {len(content)}")
    (triangles,) = struct.unpack_from("<I", content, _STL_HEADER_BYTES - 4)
    expected = _STL_HEADER_BYTES + _STL_TRIANGLE_BYTES * triangles
    if len(content) < expected:
        raise MeshError(
            f"{file}: expected {expected} bytes for {triangles} triangles, got {len(content)}; it is cut off, or no STL"
        )
    if len(content) > expected:
        logger.warning("%s: passed over %d bytes after its %d triangles", file, len(content) - expected, triangles)
    return content[:expected]


def _merge_vertices(vertices: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return distinct vertices (W, 3), and for each given vertex (V,) its index among them."""
    rounded = np.round(vertices.astype(np.float64) / MERGE_DISTANCE_M).astype(np.int64)
    order = np.lexsort((rounded[:, 2], rounded[:, 1], rounded[:, 0]))
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (np.diff(rounded[order], axis=0) != 0).any(axis=1)
    corner = np.empty(len(order), dtype=np.int64)
    corner[order] = np.cumsum(is_new) - 1
    return vertices[order[is_new]], corner


def _bounds_volume(faces: NDArray[np.int64]) -> bool:
    """Return True if each edge has as many uses in one direction as in the other: no surface ends or flips."""
    edges = np.concatenate((faces[:, (0, 1)], faces[:, (1, 2)], faces[:, (2, 0)]))
    edges = edges[edges[:, 0] != edges[:, 1]]
    low, high = edges.min(axis=1), edges.max(axis=1)
    direction = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    order = np.lexsort((high, low))
    low, high, direction = low[order], high[order], direction[order]
    starts = np.flatnonzero(np.concatenate(([True], (np.diff(low) != 0) | (np.diff(high) != 0))))
    return bool(len(edges)) and not np.add.reduceat(direction, starts).any()


def _face_outwards(points: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], bool]:
    """Turn the parts of a closed surface that face inwards, but for those that bound a hollow inside another part.

    Returns the faces (F, 3), and False when a part was turned: a solid that was exported inside out, or a room that is
    seen from inside. Which of them it is nobody can tell, so both its sides must be drawn.
    """
    part = _connected_parts(len(points), faces)[faces[:, 0]]
    a, b, c = (points[faces[:, k]] for k in range(3))
    six_volumes = np.bincount(part, weights=np.einsum("ij,ij->i", a, np.cross(b, c)))
    inwards = [label for label in np.flatnonzero(six_volumes < 0.0) if not _is_hollow(points, faces, part, label)]
    turned = np.isin(part, inwards)
    return np.where(turned[:, None], faces[:, ::-1], faces), not turned.any()


def _is_hollow(
    points: NDArray[np.float64], faces: NDArray[np.int64], part: NDArray[np.int64], label: np.intp | int
) -> bool:
    """Return True if a part lies inside the other parts: the surfaces around it add up to a winding number of 1."""
    own = part == label
    inside = points[faces[own][0, 0]]
    corners = points[faces[~own]] - inside
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    length_a, length_b, length_c = (np.linalg.norm(corners[:, k], axis=1) for k in range(3))
    # The solid angle of each triangle (Van Oosterom and Strackee, 1983).
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    rest = length_a * length_b * length_c
    rest += np.einsum("ij,ij->i", a, b) * length_c
    rest += np.einsum("ij,ij->i", b, c) * length_a
    rest += np.einsum("ij,ij->i", c, a) * length_b
    return bool(2.0 * np.arctan2(triple, rest).sum() / (4.0 * np.pi) > 0.5)


def _connected_parts(vertex_count: int, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a label (V,) for each vertex; vertices connected by triangles have equal labels."""
    label = np.arange(vertex_count)
    while True:
        lowest = label[faces].min(axis=1)
        spread = label.copy()
        np.minimum.at(spread, faces.ravel(), np.repeat(lowest, 3))
        # Replacing each label by its label's label halves the remaining distance: long parts need few rounds.
        spread = np.minimum(spread, spread[spread])
        if np.array_equal(spread, label):
            return label
        label = spread
