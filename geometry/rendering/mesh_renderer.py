# SPDX-License-Identifier: Apache-2.0
"""Meshes and the links of a robot rendered into buffers of inverse depth, in memory allocated beforehand."""

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
"""Near plane, where triangles are clipped: nearer than the range of any depth camera."""

STILL_M = 0.0005
"""Encoder noise: links that moved by less than this since they were last drawn are not drawn again."""

KEPT_AFTER = 3
"""Number of drawings for which a link must be still before it is kept in a buffer of its own, under the other links.
With 1, a robot that stops and starts by turns would have everything drawn twice."""


class DepthBuffer:
    """Nearest and farthest inverse depth, 1/m, of a window of the image; `rasterize` explains the format.

    Attributes:
        bundle: all arrays, for kernels.
    """

    def __init__(self, intrinsics: Intrinsics, farthest: bool = False) -> None:
        """Allocate the buffer; without `farthest` it holds only the nearest surface."""
        size = intrinsics.height * (intrinsics.width + rasterize.LANES) + rasterize.LANES
        self.nearest_w = np.zeros(size, np.float32)
        self.farthest_w = np.zeros(size if farthest else 0, np.float32)
        self.window = np.zeros(4, np.int64)
        self.bundle = plain(Buffer(self.window, self.nearest_w, self.farthest_w))

    def nearest_in(self, image_w: NDArray[np.float32], rectangles: NDArray[np.int32]) -> None:
        """Copy the pixels inside the `rectangles` (M, 4) into `image_w` (H, W)."""
        row, column, rows, stride = self.window.tolist()
        window_w = self.nearest_w[: rows * stride].reshape(rows, stride)
        for top, bottom, left, right in rectangles.tolist():
            part = window_w[top - row : bottom + 1 - row, left - column : right + 1 - column]
            image_w[top : bottom + 1, left : right + 1] = part


class MeshBatch:
    """Several meshes as the flat arrays of `rasterize.draw_meshes`, with scratch memory."""

    def __init__(self, intrinsics: Intrinsics, meshes: Sequence[TriangleMesh], inflate: bool) -> None:
        """Prepare the meshes; with `inflate`, also the offsets by which they grow, else they never grow."""
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
        """Draw all meshes at poses (M, 4, 4), each inflated by its padding (M,) in metres, into `buffer`."""
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
        """Draw the `chosen` (M,) meshes over the content of `kept`, which holds the `others` (M,)."""
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
    """Rendering of a robot's links that draws only links that moved.

    Attributes:
        buffer: the result of the last drawing.
    """

    def __init__(
        self, intrinsics: Intrinsics, meshes: Sequence[TriangleMesh], inflate: bool, farthest: bool = False
    ) -> None:
        """Prepare the links; `inflate` as for `MeshBatch`, `farthest` as for `DepthBuffer`."""
        self._batch = MeshBatch(intrinsics, meshes, inflate)
        self._reach_m = np.array([float(np.linalg.norm(mesh.vertices, axis=1).max()) for mesh in meshes])
        self.buffer = DepthBuffer(intrinsics, farthest)
        self._kept = DepthBuffer(intrinsics, farthest)
        self._is_kept = np.zeros(self._batch.count, np.bool_)
        self._is_drawn = np.zeros(self._batch.count, np.bool_)
        self._stillness = plain(motion.Stillness(STILL_M, KEPT_AFTER))
        self._drawn = plain(
            motion.Drawn(
                # NaN: not drawn yet.
                poses=np.full((self._batch.count, 4, 4), np.nan),
                padding_m=np.zeros(self._batch.count, np.float32),
                still_for=np.zeros(self._batch.count, np.int64),
                is_kept=self._is_kept,
                is_drawn=self._is_drawn,
            )
        )

    @property
    def rectangles(self) -> NDArray[np.int32]:
        """First and last row, first and last column (L, 4) of the pixels that each link may touch."""
        return self._batch.rectangles

    @property
    def all(self) -> NDArray[np.bool_]:
        """A mask (L,) that selects all links."""
        return self._batch.all

    def draw(self, T_camera_link: NDArray[np.float64], padding_m: NDArray[np.float32], anew: bool = True) -> bool:
        """Draw the links at poses (L, 4, 4), each inflated by its padding (L,) in metres.

        Without `anew`, draw nothing and return False if no vertex has moved by more than STILL_M.
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
    """Concatenate arrays (N, 3), and transpose to (3, sum of N) so that each coordinate is contiguous."""
    return np.ascontiguousarray(np.concatenate([*parts, np.zeros((0, 3), dtype)]).T)
