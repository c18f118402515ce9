# SPDX-License-Identifier: Apache-2.0
"""Meshes and the links of a robot drawn into buffers of inverse depth, with all memory taken beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from geometry.kernels import motion, rasterize
from geometry.kernels.bundles import plain
from geometry.kernels.project import Meshes, Scratch
from geometry.kernels.rasterize import Buffer
from geometry.rendering.kernel_camera import screen_of
from geometry.rendering.vertex_offsets import vertex_offsets
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
    """Nearest and farthest inverse depth, 1/m, of a window of the picture, as `rasterize` has it.

    Attributes:
        bundle: all of it, for kernels.
    """

    def __init__(self, intrinsics: Intrinsics, farthest: bool = False) -> None:
        """Without `farthest` only the nearest is drawn."""
        size = intrinsics.height * (intrinsics.width + rasterize.LANES) + rasterize.LANES
        self.nearest_w = np.zeros(size, np.float32)
        self.farthest_w = np.zeros(size if farthest else 0, np.float32)
        self.window = np.zeros(4, np.int64)
        self.bundle = plain(Buffer(self.window, self.nearest_w, self.farthest_w))

    def nearest_in(self, picture_w: NDArray[np.float32], rectangles: NDArray[np.int32]) -> None:
        """Write what was drawn inside the `rectangles` (M, 4) into `picture_w` (H, W)."""
        row, column, rows, stride = self.window.tolist()
        window_w = self.nearest_w[: rows * stride].reshape(rows, stride)
        for top, bottom, left, right in rectangles.tolist():
            part = window_w[top - row : bottom + 1 - row, left - column : right + 1 - column]
            picture_w[top : bottom + 1, left : right + 1] = part


class MeshBatch:
    """Several meshes as the flat arrays that `rasterize.draw_meshes` takes, with scratch memory for them."""

    def __init__(self, intrinsics: Intrinsics, meshes: Sequence[TriangleMesh], inflate: bool) -> None:
        """`inflate` prepares the offsets by which meshes grow; without it they are drawn as they are."""
        self.count = len(meshes)
        self.all = np.ones(self.count, np.bool_)
        self.rectangles = np.tile(np.array([intrinsics.height, -1, intrinsics.width, -1], np.int32), (self.count, 1))
        self._screen = screen_of(intrinsics, NEAR_PLANE_M)
        offsets = [vertex_offsets(mesh) if inflate else np.zeros_like(mesh.vertices) for mesh in meshes]
        vertices_m = _columns([mesh.vertices for mesh in meshes], np.float32)
        self._meshes = plain(
            Meshes(
                vertices_m,
                offsets=_columns(offsets, np.float32),
                faces=_columns([mesh.faces for mesh in meshes], np.int32),
                vertex_starts=np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)]).astype(np.int32),
                face_starts=np.cumsum([0, *(len(mesh.faces) for mesh in meshes)]).astype(np.int32),
                closed=np.array([mesh.closed for mesh in meshes], np.bool_),
            )
        )
        faces_max = max((len(mesh.faces) for mesh in meshes), default=1)
        self._scratch = plain(
            Scratch(
                placed=np.empty((6, vertices_m.shape[1]), np.float32),
                before=np.zeros(self.count, np.int32),
                kinds=np.empty(faces_max, np.uint8),
                lists=np.empty((3, faces_max + 1), np.int32),
                corners=np.empty((3, 3), np.float32),
                polygon=np.empty((4, 3), np.float64),
            )
        )

    def draw(self, T_camera_mesh: NDArray[np.float64], padding_m: NDArray[np.float32], buffer: DepthBuffer) -> None:
        """Draw all meshes at poses (M, 4, 4), each grown by its padding (M,), into `buffer`."""
        self.draw_over(buffer, ~self.all, T_camera_mesh, padding_m, buffer, self.all)

    def draw_over(
        self,
        kept: DepthBuffer,
        others: NDArray[np.bool_],
        T_camera_mesh: NDArray[np.float64],
        padding_m: NDArray[np.float32],
        buffer: DepthBuffer,
        chosen: NDArray[np.bool_],
    ) -> None:
        """Draw the `chosen` (M,) of the meshes over what is `kept` of the `others` (M,)."""
        rasterize.draw_meshes(
            self._meshes,
            chosen,
            others,
            T_camera_mesh,
            padding_m,
            self._screen,
            kept.bundle,
            buffer.bundle,
            self.rectangles,
            self._scratch,
        )


class LinkDrawing:
    """A robot's links on the screen, of which only those are drawn again that moved.

    Attributes:
        buffer: what was drawn last.
    """

    def __init__(
        self, intrinsics: Intrinsics, meshes: Sequence[TriangleMesh], inflate: bool, farthest: bool = False
    ) -> None:
        """`inflate` as for a `MeshBatch`, `farthest` as for a `DepthBuffer`."""
        self._batch = MeshBatch(intrinsics, meshes, inflate)
        self._reach_m = np.array([float(np.linalg.norm(mesh.vertices, axis=1).max()) for mesh in meshes])
        self.buffer = DepthBuffer(intrinsics, farthest)
        self._kept = DepthBuffer(intrinsics, farthest)
        self._is_kept = np.zeros(self._batch.count, np.bool_)
        self._is_drawn = np.zeros(self._batch.count, np.bool_)
        self._stillness = plain(motion.Stillness(STILL_M, KEPT_AFTER))
        self._drawn = plain(
            motion.Drawn(
                # Nowhere yet.
                poses=np.full((self._batch.count, 4, 4), np.nan),
                padding_m=np.zeros(self._batch.count, np.float32),
                still_for=np.zeros(self._batch.count, np.int64),
                is_kept=self._is_kept,
                is_drawn=self._is_drawn,
            )
        )

    @property
    def rectangles(self) -> NDArray[np.int32]:
        """First and last row, first and last column (L, 4) that each link may have touched."""
        return self._batch.rectangles

    @property
    def all(self) -> NDArray[np.bool_]:
        """All links (L,)."""
        return self._batch.all

    def draw(self, T_camera_link: NDArray[np.float64], padding_m: NDArray[np.float32], anew: bool = True) -> bool:
        """Draw the links at poses (L, 4, 4), each grown by its padding (L,) m.

        Unless it must be `anew`, nothing is drawn and False returned when no vertex has moved by more than STILL_M.
        """
        found = motion.settle(
            T_camera_link,
            padding_m,
            self._reach_m,
            self._stillness,
            anew,
            self._drawn,
        )
        if found == motion.STILL:
            return False
        batch, kept = self._batch, self._kept
        if found == motion.KEPT_CHANGES:
            batch.draw_over(kept, ~batch.all, T_camera_link, padding_m, kept, self._is_kept)
        batch.draw_over(kept, self._is_kept, T_camera_link, padding_m, self.buffer, self._is_drawn)
        return True


def _columns(parts: Sequence[NDArray[Number]], dtype: type[Number]) -> NDArray[Number]:
    """Arrays (N, 3) one after the other as (3, sum of N): each coordinate by itself."""
    return np.ascontiguousarray(np.concatenate([*parts, np.zeros((0, 3), dtype)]).T)
