# SPDX-License-Identifier: Apache-2.0
"""Meshes and the links of a robot drawn into buffers of inverse depth, with all memory taken beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from edge_unit.inflation import vertex_offsets
from edge_unit.kernels import rasterize
from shared.camera import Intrinsics
from shared.meshes import TriangleMesh

Number = TypeVar("Number", np.float32, np.int32)

NEAR_PLANE_M = 0.01
"""Nearer than any depth camera measures; triangles are clipped here."""

STILL_M = 0.0005
"""Encoders tremble: links that moved by less than this since they were drawn are not drawn again."""

KEPT_AFTER = 3
"""A link that stood still for so many drawings is kept aside, and the others are drawn over it. At once would be too
early: a robot that stops and goes by turns would have everything drawn twice."""


class DepthBuffer:
    """Nearest and farthest inverse depth, (H, more than W) float32 of 1/m; columns beyond the picture mean nothing."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        shape = (intrinsics.height, intrinsics.width + rasterize.LANES)
        self.nearest_w = np.full(shape, rasterize.NOTHING_NEAREST, np.float32)
        self.farthest_w = np.full(shape, rasterize.NOTHING_FARTHEST, np.float32)


class MeshBatch:
    """Several meshes as the flat arrays that `rasterize.draw_meshes` takes, with scratch memory for them."""

    def __init__(self, meshes: Sequence[TriangleMesh], inflate: bool) -> None:
        """`inflate` prepares the offsets by which meshes grow; without it they are drawn as they are."""
        self.count = len(meshes)
        vertices = [mesh.vertices for mesh in meshes]
        offsets = [vertex_offsets(mesh) if inflate else np.zeros_like(mesh.vertices) for mesh in meshes]
        self.vertices_m = _columns(vertices, np.float32)
        self.offsets = _columns(offsets, np.float32)
        self.faces = _columns([mesh.faces for mesh in meshes], np.int32)
        self.vertex_starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)]).astype(np.int32)
        self.face_starts = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)]).astype(np.int32)
        self.closed = np.array([mesh.closed for mesh in meshes], dtype=np.bool_)
        self.all = np.ones(self.count, np.bool_)
        self.rectangles = np.tile(np.array([0, -1, 0, -1], np.int32), (self.count, 1))
        vertices_max = max((len(mesh.vertices) for mesh in meshes), default=1)
        faces_max = max((len(mesh.faces) for mesh in meshes), default=1)
        self._placed = np.empty((6, vertices_max), np.float32)
        self._kinds = np.empty(faces_max, np.uint8)
        self._lists = np.empty((3, faces_max + 1), np.int32)
        self._corners = np.empty((3, 3), np.float32)
        self._polygon = np.empty((4, 3), np.float64)

    def draw(
        self,
        intrinsics: Intrinsics,
        T_camera_mesh: NDArray[np.float64],
        padding_m: NDArray[np.float32],
        buffer: DepthBuffer,
        chosen: NDArray[np.bool_] | None = None,
    ) -> None:
        """Draw meshes at poses (M, 4, 4), each grown by its padding (M,); all of them, or the `chosen` (M,)."""
        rasterize.draw_meshes(
            self.vertices_m,
            self.offsets,
            self.faces,
            self.vertex_starts,
            self.face_starts,
            self.closed,
            self.all if chosen is None else chosen,
            np.ascontiguousarray(T_camera_mesh[:, :3, :], dtype=np.float32),
            padding_m,
            np.float32(intrinsics.fx),
            np.float32(intrinsics.fy),
            np.float32(intrinsics.cx),
            np.float32(intrinsics.cy),
            np.float32(NEAR_PLANE_M),
            intrinsics.width,
            self._placed,
            self._kinds,
            self._lists,
            self._corners,
            self._polygon,
            buffer.nearest_w,
            buffer.farthest_w,
            self.rectangles,
        )


class LinkDrawing:
    """A robot's links on the screen, of which only those are drawn again that moved.

    `buffer` holds the drawing once, until `draw` is called again: whoever reads it puts back what `kept` holds, in the
    same pass, while it is hot in the cache.
    """

    def __init__(self, intrinsics: Intrinsics, meshes: Sequence[TriangleMesh], inflate: bool) -> None:
        self._intrinsics = intrinsics
        self._batch = MeshBatch(meshes, inflate)
        self._reach_m = np.array([float(np.linalg.norm(mesh.vertices, axis=1).max()) for mesh in meshes])
        self.buffer = DepthBuffer(intrinsics)
        self.kept = DepthBuffer(intrinsics)
        self._is_kept = np.zeros(self._batch.count, np.bool_)
        self._still_for = np.zeros(self._batch.count, np.int64)
        # Nowhere yet: whatever comes has moved.
        self._poses = np.full((self._batch.count, 4, 4), np.inf)
        self._padding_m = np.zeros(self._batch.count, np.float32)

    @property
    def rectangles(self) -> NDArray[np.int32]:
        """First and last row, first and last column (L, 4) that each link may have touched."""
        return self._batch.rectangles

    def draw(self, T_camera_link: NDArray[np.float64], padding_m: NDArray[np.float32], anew: bool = True) -> bool:
        """Draw the links at poses (L, 4, 4), each grown by its padding (L,) m.

        Unless it must be `anew`, nothing is drawn and False returned when no vertex has moved by more than STILL_M.
        """
        moved = self._moved(T_camera_link, padding_m)
        if not anew and not moved.any():
            return False
        self._still_for[moved] = 0
        self._still_for[~moved] += 1
        still = self._still_for >= KEPT_AFTER
        if (self._is_kept & moved).any() or (still & ~self._is_kept).any():
            self._keep(still, T_camera_link, padding_m)
        drawn = ~self._is_kept
        self._batch.draw(self._intrinsics, T_camera_link, padding_m, self.buffer, drawn)
        self._poses[drawn] = T_camera_link[drawn]
        self._padding_m[drawn] = padding_m[drawn]
        return True

    def _keep(
        self, still: NDArray[np.bool_], T_camera_link: NDArray[np.float64], padding_m: NDArray[np.float32]
    ) -> None:
        """Have the links that are `still` (L,), and no others, in the drawing that is kept aside."""
        batch, kept, buffer = self._batch, self.kept, self.buffer
        rectangles = batch.rectangles
        rasterize.clear_rectangles(rectangles, self._is_kept, kept.nearest_w, kept.farthest_w)
        rasterize.clear_rectangles(rectangles, self._is_kept, buffer.nearest_w, buffer.farthest_w)
        batch.draw(self._intrinsics, T_camera_link, padding_m, kept, still)
        rasterize.copy_rectangles(
            rectangles, still, kept.nearest_w, kept.farthest_w, buffer.nearest_w, buffer.farthest_w
        )  # fmt: skip
        self._poses[still] = T_camera_link[still]
        self._padding_m[still] = padding_m[still]
        self._is_kept = still

    def _moved(self, T_camera_link: NDArray[np.float64], padding_m: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which links (L,) have a vertex that may have moved by more than STILL_M since it was drawn."""
        change = np.abs(T_camera_link - self._poses)
        moved_m = change[:, :3, 3].sum(axis=1) + change[:, :3, :3].sum(axis=(1, 2)) * self._reach_m
        return np.asarray(moved_m + np.abs(padding_m - self._padding_m) > STILL_M)


def _columns(parts: Sequence[NDArray[Number]], dtype: type[Number]) -> NDArray[Number]:
    """Arrays (N, 3) one after the other as (3, sum of N): each coordinate by itself."""
    return np.ascontiguousarray(np.concatenate([*parts, np.zeros((0, 3), dtype)]).T)
