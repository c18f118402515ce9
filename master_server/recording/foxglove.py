# SPDX-License-Identifier: Apache-2.0
"""Convert a moment to Foxglove's own schemas; all in the frame `world`, in metres, colours 0 to 1."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.ModelPrimitive_pb2 import ModelPrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray
from trimesh.transformations import quaternion_from_matrix

from master_server.core import MapView
from master_server.recording.moment import Moment
from shared.cell import Cell, PlacedMesh
from shared.lattice import Lattice
from shared.meshes import TriangleMesh
from shared.transforms import Transform

WORLD = "world"

POINT = np.dtype({"names": ["x", "y", "z", "witnesses"], "formats": ["<f4", "<f4", "<f4", "u1"], "itemsize": 16})
"""Bytes of one voxel's centre; padded, so that every point is aligned."""

FIELD_TYPES = {"<f4": PackedElementField.FLOAT32, "|u1": PackedElementField.UINT8}

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])

MAX_UNSEEN_BOXES = 2048
"""With more boxes, nobody can distinguish them, and building them would take longer than the recording period."""

CAD_COLOR = Color(r=0.6, g=0.62, b=0.65, a=1.0)
ROBOT_COLOR = Color(r=0.25, g=0.45, b=0.8, a=0.6)
BOX_COLOR = Color(r=0.9, g=0.9, b=0.9, a=0.8)
UNSEEN_COLOR = Color(r=0.85, g=0.6, b=0.1, a=0.08)
BOX_LINE_PX = 1.5

LENGTH_DELIMITED = 2
"""Protobuf's wire type of a nested message."""


def stamp_of(log_ns: int) -> Timestamp:
    """Convert nanoseconds since 1970 to Foxglove's time."""
    stamp = Timestamp()
    stamp.FromNanoseconds(log_ns)
    return stamp


def point_cloud(view: MapView, stamp: Timestamp) -> PointCloud:
    """Return the voxels' centres, each with the number of units that report it."""
    centres = view.lattice.centres(view.lattice.indices(view.keys))
    points = np.zeros(len(centres), POINT)
    points["x"], points["y"], points["z"] = centres.T
    points["witnesses"] = view.witnesses
    assert POINT.fields is not None
    return PointCloud(
        timestamp=stamp,
        frame_id=WORLD,
        pose=_pose(np.eye(4)),
        point_stride=POINT.itemsize,
        fields=[
            PackedElementField(name=name, offset=offset, type=FIELD_TYPES[kind.str])
            for name, (kind, offset, *_) in POINT.fields.items()
        ],
        data=points.tobytes(),
    )


def transforms(moment: Moment, stamp: Timestamp) -> FrameTransforms:
    """Return the known poses of cameras (`unit_3`), objects (`object/pallet`) and links (`robot/forearm`)."""
    found = [
        _transform(f"unit_{row.id}", np.array(row.T_world_camera), stamp)
        for row in moment.units
        if row.T_world_camera is not None
    ]
    found += [_transform(_object_frame(body), body.T_world_mesh, stamp) for body in moment.cell.objects]
    robot = moment.cell.robot
    if robot is not None and moment.robot.joints:
        poses = robot.link_poses(moment.robot.joints[-1].positions)
        found += [_transform(_link_frame(link.name), poses[link.index], stamp) for link in robot.links]
    return FrameTransforms(transforms=found)


def cell_scene(cell: Cell, stamp: Timestamp) -> SceneUpdate:
    """Return the cell's box as lines, and its CAD and the robot's links as models; replaces an earlier cell.

    The poses of objects and links come from `transforms`, so that a moving pallet is not drawn again and again.
    """
    entities = [SceneEntity(timestamp=stamp, frame_id=WORLD, id="box", lines=[_box_lines(cell)])]
    entities += [
        _model(f"cad/{body.name}", WORLD, body.mesh, body.T_world_mesh, CAD_COLOR, stamp) for body in cell.static
    ]
    entities += [
        _model(_object_frame(body), _object_frame(body), body.mesh, np.eye(4), CAD_COLOR, stamp)
        for body in cell.objects
    ]
    if cell.robot is not None:
        entities += [
            _model(_link_frame(link.name), _link_frame(link.name), link.mesh, np.eye(4), ROBOT_COLOR, stamp)
            for link in cell.robot.links
        ]
    deletion = SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletion.ALL)
    return SceneUpdate(deletions=[deletion], entities=entities)


def unseen_scene(blocks: Lattice, seen_by: NDArray[np.uint8], stamp: Timestamp) -> SceneUpdate:
    """Return the unseen blocks as translucent boxes; adjacent blocks are joined. At most MAX_UNSEEN_BOXES."""
    first, last = boxes_of(seen_by == 0)
    sizes = last - first
    if len(first) > MAX_UNSEEN_BOXES:
        largest = np.argsort(-sizes.prod(axis=1), kind="stable")[:MAX_UNSEEN_BOXES]
        first, sizes = first[largest], sizes[largest]
    edges_m = sizes.astype(np.float64) * blocks.voxel_size_m
    middles_m = np.array(blocks.origin_m) + first * blocks.voxel_size_m + edges_m / 2.0
    entity = SceneEntity(timestamp=stamp, frame_id=WORLD, id="unseen")
    entity.MergeFromString(_cubes(middles_m, edges_m))
    return SceneUpdate(entities=[entity])


def boxes_of(chosen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return boxes that together cover exactly the chosen blocks: first (N, 3), and one beyond the last (N, 3).

    Runs along z are joined along y where they are equal, then along x.
    """
    padded = np.pad(chosen, ((0, 0), (0, 0), (1, 1))).astype(np.int8)
    steps = np.diff(padded, axis=2)
    x, y, begin = np.nonzero(steps == 1)
    end = np.nonzero(steps == -1)[2]
    first, last = np.stack((x, y, begin), axis=1), np.stack((x + 1, y + 1, end), axis=1)
    for axis in (1, 0):
        first, last = _joined(first, last, axis)
    return first, last


def stl_of(mesh: TriangleMesh) -> bytes:
    """Return a mesh as binary STL, in metres."""
    corners = mesh.vertices[mesh.faces].astype(np.float32)
    triangles = np.zeros(len(corners), STL_TRIANGLE)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)
    triangles["corners"] = corners
    return bytes(80) + len(triangles).to_bytes(4, "little") + triangles.tobytes()


def _cubes(middles_m: NDArray[np.float64], edges_m: NDArray[np.float64]) -> bytes:
    """Return the field `cubes` of a SceneEntity in protobuf's encoding, upright boxes with middles and edges (N, 3).

    The library encodes one box, and its six numbers are replaced for all others. Thousands of objects would hold the
    interpreter for 30 ms, and every update of a unit would wait.
    """
    marks = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
    x, y, z, a, b, c = marks
    pose = Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=1.0))
    one = CubePrimitive(pose=pose, size=Vector3(x=a, y=b, z=c), color=UNSEEN_COLOR).SerializeToString()
    encoded = bytes(((SceneEntity.CUBES_FIELD_NUMBER << 3) | LENGTH_DELIMITED, len(one))) + one
    rows = np.tile(np.frombuffer(encoded, np.uint8), (len(middles_m), 1))
    for mark, column in zip(marks, np.hstack((middles_m, edges_m)).T, strict=True):
        place = encoded.index(struct.pack("<d", mark))
        rows[:, place : place + 8] = column.astype("<f8")[:, None].view(np.uint8)
    return rows.tobytes()


def _joined(
    first: NDArray[np.int64], last: NDArray[np.int64], axis: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Join boxes that touch along `axis` and are equal along the other axes."""
    others = [other for other in range(3) if other != axis]
    order = np.lexsort((first[:, axis], *(last[:, other] for other in others), *(first[:, other] for other in others)))
    first, last = first[order], last[order]
    alike = (first[1:, others] == first[:-1, others]).all(axis=1) & (last[1:, others] == last[:-1, others]).all(axis=1)
    begins = np.ones(len(first), np.bool_)
    begins[1:] = ~(alike & (first[1:, axis] == last[:-1, axis]))
    starts = np.nonzero(begins)[0]
    joined_last = last[np.append(starts[1:], len(first)) - 1] if len(first) else last
    return first[starts], joined_last


def _link_frame(name: str) -> str:
    return f"robot/{name}"


def _object_frame(body: PlacedMesh) -> str:
    return f"object/{body.name}"


def _transform(child: str, T_world_child: Transform, stamp: Timestamp) -> FrameTransform:
    pose = _pose(T_world_child)
    return FrameTransform(
        timestamp=stamp,
        parent_frame_id=WORLD,
        child_frame_id=child,
        translation=pose.position,
        rotation=pose.orientation,
    )


def _model(
    name: str, frame: str, mesh: TriangleMesh, T_frame_mesh: Transform, color: Color, stamp: Timestamp
) -> SceneEntity:
    model = ModelPrimitive(
        pose=_pose(T_frame_mesh),
        scale=Vector3(x=1.0, y=1.0, z=1.0),
        color=color,
        override_color=True,
        media_type="model/stl",
        data=stl_of(mesh),
    )
    return SceneEntity(timestamp=stamp, frame_id=frame, id=name, frame_locked=True, models=[model])


def _box_lines(cell: Cell) -> LinePrimitive:
    corners = [Point3(x=x, y=y, z=z) for x, y, z in _corners(cell)]
    edges = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
    return LinePrimitive(
        type=LinePrimitive.LINE_LIST,
        pose=_pose(np.eye(4)),
        thickness=BOX_LINE_PX,
        scale_invariant=True,
        points=[corners[index] for edge in edges for index in edge],
        color=BOX_COLOR,
    )


def _corners(cell: Cell) -> Iterator[tuple[float, float, float]]:
    spans = [(float(low), float(high)) for low, high in zip(cell.box_min_m, cell.box_max_m, strict=True)]
    yield from ((spans[0][i & 1], spans[1][i >> 1 & 1], spans[2][i >> 2]) for i in range(8))


def _pose(transform: Transform) -> Pose:
    w, x, y, z = quaternion_from_matrix(transform, isprecise=True).tolist()
    px, py, pz = transform[:3, 3].tolist()
    return Pose(position=Vector3(x=px, y=py, z=pz), orientation=Quaternion(x=x, y=y, z=z, w=w))
