# SPDX-License-Identifier: Apache-2.0
"""What the camera should see, in two layers that stay apart: what stands still, and the robot (Algorithms 2 to 5).

The static layer is drawn when the camera or a known object moves. The robot is drawn again when its joints moved,
only inside the rectangles of its links, as solids that are its padding larger, so that the filter only compares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge_unit.hull import DISTANCE_MIN_M, hull_around
from edge_unit.inflation import vertex_offsets
from edge_unit.kernels import limits, rasterize
from shared.camera import Intrinsics
from shared.kinematics import Robot
from shared.meshes import TriangleMesh
from shared.transforms import Transform, inverse

NEAR_PLANE_M = 0.01
"""Nearer than any depth camera measures; triangles are clipped here."""

STILL_M = 0.0005
"""Encoders tremble: links that moved by less than this since they were drawn are not drawn again."""


class MeshBatch:
    """Several meshes as the flat arrays that `rasterize.draw_meshes` takes, with scratch memory for them."""

    def __init__(self, meshes: Sequence[TriangleMesh], inflate: bool) -> None:
        """`inflate` prepares the offsets by which meshes grow; without it they are drawn as they are."""
        self.count = len(meshes)
        vertices = [mesh.vertices for mesh in meshes]
        offsets = [vertex_offsets(mesh) if inflate else np.zeros_like(mesh.vertices) for mesh in meshes]
        self.vertices_m = np.concatenate([*vertices, np.zeros((0, 3), np.float32)]).astype(np.float32)
        self.offsets = np.concatenate([*offsets, np.zeros((0, 3), np.float32)]).astype(np.float32)
        self.faces = np.concatenate([*(mesh.faces for mesh in meshes), np.zeros((0, 3), np.int32)]).astype(np.int32)
        self.vertex_starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)]).astype(np.int32)
        self.face_starts = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)]).astype(np.int32)
        self.closed = np.array([mesh.closed for mesh in meshes], dtype=np.bool_)
        self.rectangles = np.tile(np.array([0, -1, 0, -1], np.int32), (self.count, 1))
        self._screen = np.empty((max((len(mesh.vertices) for mesh in meshes), default=1), 6), np.float32)
        self._corners = np.empty((3, 3), np.float32)
        self._polygon = np.empty((4, 3), np.float64)

    def draw(
        self,
        intrinsics: Intrinsics,
        T_camera_mesh: NDArray[np.float64],
        padding_m: NDArray[np.float32],
        nearest_w: NDArray[np.float32],
        farthest_w: NDArray[np.float32],
    ) -> None:
        """Draw all meshes at poses (M, 4, 4), each grown by its padding (M,), into (H, W) buffers of 1/m."""
        rasterize.draw_meshes(
            self.vertices_m,
            self.offsets,
            self.faces,
            self.vertex_starts,
            self.face_starts,
            self.closed,
            np.ascontiguousarray(T_camera_mesh[:, :3, :], dtype=np.float32),
            padding_m,
            intrinsics.fx,
            intrinsics.fy,
            intrinsics.cx,
            intrinsics.cy,
            NEAR_PLANE_M,
            self._screen,
            self._corners,
            self._polygon,
            nearest_w,
            farthest_w,
            self.rectangles,
        )


class DepthBuffer:
    """Nearest and farthest inverse depth, (H, W) float32 of 1/m."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        self.nearest_w = np.full(intrinsics.shape, rasterize.NOTHING_NEAREST, np.float32)
        self.farthest_w = np.full(intrinsics.shape, rasterize.NOTHING_FARTHEST, np.float32)

    def clear(self, rectangles: NDArray[np.int32]) -> None:
        """Forget what was drawn inside the rectangles (M, 4)."""
        rasterize.clear_rectangles(self.nearest_w, self.farthest_w, rectangles)

    def clear_all(self) -> None:
        """Forget everything."""
        self.nearest_w.fill(rasterize.NOTHING_NEAREST)
        self.farthest_w.fill(rasterize.NOTHING_FARTHEST)


class StaticLayer:
    """The CAD and the known objects, drawn once for each camera pose and object pose; unpadded."""

    def __init__(self, intrinsics: Intrinsics, meshes: Sequence[TriangleMesh]) -> None:
        self._intrinsics = intrinsics
        self._batch = MeshBatch(meshes, inflate=False)
        self._buffer = DepthBuffer(intrinsics)

    @property
    def nearest_w(self) -> NDArray[np.float32]:
        """Inverse depth (H, W) of the nearest surface, 1/m; 0 where there is none."""
        return self._buffer.nearest_w

    def draw(self, T_world_camera: Transform, T_world_mesh: Sequence[Transform]) -> None:
        """Draw all meshes anew at their poses."""
        self._buffer.clear_all()
        if self._batch.count:
            T_camera_mesh = inverse(T_world_camera) @ np.stack(T_world_mesh)
            padding = np.zeros(self._batch.count, np.float32)
            self._batch.draw(self._intrinsics, T_camera_mesh, padding, self._buffer.nearest_w, self._buffer.farthest_w)


class RobotLayer:
    """The padded robot, as the band of raw depths that belongs to it."""

    def __init__(self, intrinsics: Intrinsics, robot: Robot | None, padding_m: float) -> None:
        """`padding_m` is what the links are usually drawn with: they are prepared for it."""
        self._intrinsics = intrinsics
        self._robot = robot
        self._hull_m = max(padding_m, DISTANCE_MIN_M)
        hulls = [hull_around(link.mesh, self._hull_m) for link in robot.links] if robot else []
        self._batch = MeshBatch(hulls, inflate=True)
        self._buffer = DepthBuffer(intrinsics)
        self._reach_m = _link_reach(robot)
        self._drawn: tuple[NDArray[np.float64], NDArray[np.float32]] | None = None
        self.near_raw = np.full(intrinsics.shape, limits.RAW_MAX, np.uint16)
        self.span_raw = np.zeros(intrinsics.shape, np.uint16)
        self.rows = np.array([0, -1, 0, -1], np.int32)

    def forget(self) -> None:
        """Take the robot out: without joints nobody knows where it stands, and it is reported, not filtered."""
        self._clear()
        self._drawn = None

    def draw(
        self,
        T_camera_link: NDArray[np.float64],
        padding_m: NDArray[np.float32],
        noise_per_m: float,
        depth_m: float,
        hidden: NDArray[np.bool_] | None = None,
    ) -> bool:
        """Draw the links at poses (L, 4, 4), each grown by its padding (L,) m; returns False when none had moved.

        `noise_per_m` and `depth_m`, from the padded surface, widen the band as `limits.robot_band_raw` has it.
        `hidden` (L,) links are left out.
        """
        if hidden is not None and hidden.any():
            T_camera_link = T_camera_link.copy()
            # Behind the camera nothing is drawn.
            T_camera_link[hidden, :3, :3] = 0.0
            T_camera_link[hidden, 2, 3] = -1.0
        if self._still(T_camera_link, padding_m):
            return False
        self._clear()
        buffer = self._buffer
        self._batch.draw(
            self._intrinsics, T_camera_link, padding_m - np.float32(self._hull_m), buffer.nearest_w, buffer.farthest_w
        )
        limits.robot_band_raw(
            buffer.nearest_w,
            buffer.farthest_w,
            self._batch.rectangles,
            noise_per_m,
            depth_m,
            self._intrinsics.depth_scale_m,
            self.near_raw,
            self.span_raw,
        )
        rectangles = self._batch.rectangles
        if self._batch.count:
            self.rows[:] = (
                rectangles[:, 0].min(),
                rectangles[:, 1].max(),
                rectangles[:, 2].min(),
                rectangles[:, 3].max(),
            )
        self._drawn = (T_camera_link.copy(), padding_m.copy())
        return True

    def _still(self, T_camera_link: NDArray[np.float64], padding_m: NDArray[np.float32]) -> bool:
        """No vertex has moved by more than STILL_M since the last drawing."""
        if self._drawn is None:
            return False
        drawn_pose, drawn_padding = self._drawn
        change = np.abs(T_camera_link - drawn_pose)
        moved = change[:, :3, 3].sum(axis=1) + change[:, :3, :3].sum(axis=(1, 2)) * self._reach_m
        return bool((moved + np.abs(padding_m - drawn_padding) <= STILL_M).all())

    def _clear(self) -> None:
        limits.clear_band(self._batch.rectangles, self.near_raw, self.span_raw)
        self.rows[:] = (0, -1, 0, -1)


class BareRobot:
    """The robot as it is, without padding: for pictures and for `expected_depth`, not for the filter."""

    def __init__(self, intrinsics: Intrinsics, robot: Robot | None) -> None:
        self._intrinsics = intrinsics
        self._batch = MeshBatch([link.mesh for link in robot.links] if robot else [], inflate=False)
        self._buffer = DepthBuffer(intrinsics)

    def nearest_w(self, T_camera_link: NDArray[np.float64]) -> NDArray[np.float32]:
        """Inverse depth (H, W) of the links at poses (L, 4, 4), 1/m; 0 beside them. Valid until the next call."""
        self._buffer.clear(self._batch.rectangles)
        padding = np.zeros(self._batch.count, np.float32)
        self._batch.draw(self._intrinsics, T_camera_link, padding, self._buffer.nearest_w, self._buffer.farthest_w)
        return self._buffer.nearest_w


def _link_reach(robot: Robot | None) -> NDArray[np.float64]:
    """Distance (L,) in metres of each link's farthest vertex from the origin of its frame."""
    if robot is None:
        return np.zeros(0)
    return np.array([float(np.linalg.norm(link.mesh.vertices, axis=1).max()) for link in robot.links])
