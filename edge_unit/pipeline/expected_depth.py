# SPDX-License-Identifier: Apache-2.0
"""Expected depth, in two layers that stay apart: static surfaces, and the robot (Algorithms 2 to 5).

The static layer is drawn after a move of the camera or of a known object. The robot is drawn after a move of its
joints, only inside the rectangles of its links, as solids enlarged by the padding, so that the filter only compares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geometry.kernels import limits
from geometry.kernels.bundles import plain
from geometry.rendering import DepthBuffer, LinkDrawing, MeshBatch, hull_around
from geometry.rendering.padded_hull import DISTANCE_MIN_M
from shared.camera import Intrinsics
from shared.cell import PlacedMesh
from shared.kinematics import Robot
from shared.transforms import Transform, inverse


class StaticLayer:
    """Static bodies, CAD or known objects, unpadded: drawn once for each pose of theirs and the camera's.

    Attributes:
        nearest_w: inverse depth (H, W) of the nearest surface, 1/m; 0 where there is none.
    """

    def __init__(self, intrinsics: Intrinsics, bodies: Sequence[PlacedMesh], batch: MeshBatch | None = None) -> None:
        """`batch` already has their meshes."""
        self._intrinsics = intrinsics
        self._bodies = tuple(bodies)
        self._batch = batch or MeshBatch(intrinsics, [body.mesh for body in bodies], inflate=False)
        self._T_world_camera: Transform | None = None
        self.nearest_w = np.zeros(intrinsics.shape, np.float32)

    def of(self, bodies: Sequence[PlacedMesh]) -> StaticLayer:
        """Return the layer of these bodies: this one if no pose changed, else a new one with the same meshes."""
        if _stand_still(self._bodies, bodies):
            return self
        same_meshes = [body.mesh for body in bodies] == [body.mesh for body in self._bodies]
        return StaticLayer(self._intrinsics, bodies, self._batch if same_meshes else None)

    def draw(self, T_world_camera: Transform) -> None:
        """Draw all bodies from the camera's pose, unless they are drawn for it already."""
        if self._T_world_camera is not None and np.array_equal(T_world_camera, self._T_world_camera):
            return
        self._T_world_camera = T_world_camera
        self.nearest_w = np.zeros(self._intrinsics.shape, np.float32)
        if self._bodies:
            buffer = DepthBuffer(self._intrinsics)
            T_camera_mesh = inverse(T_world_camera) @ np.stack([body.T_world_mesh for body in self._bodies])
            self._batch.draw(T_camera_mesh, np.zeros(self._batch.count, np.float32), buffer)
            buffer.nearest_in(self.nearest_w, self._batch.rectangles)


def _stand_still(old: Sequence[PlacedMesh], new: Sequence[PlacedMesh]) -> bool:
    """Return True if the same meshes have the same poses; a mesh is the same only as the same object."""
    return len(old) == len(new) and all(
        one.mesh is other.mesh and np.array_equal(one.T_world_mesh, other.T_world_mesh)
        for one, other in zip(old, new, strict=True)
    )


class RobotLayer:
    """The padded robot, as the band of raw depths that it covers.

    Attributes:
        padding_m: (L,) float32, the usual padding of the links.
        near_raw, span_raw: (H, W) uint16, the band's lower end and its length.
        columns: (H, 2) int32, for each row the first column and the one after the last that may have a band.
        bundle: all three, for kernels.
    """

    def __init__(self, intrinsics: Intrinsics, robot: Robot | None, padding_m: float) -> None:
        """`padding_m` is the usual padding of the links: their padded meshes are prepared for it."""
        self._intrinsics = intrinsics
        self._hull_m = max(padding_m, DISTANCE_MIN_M)
        hulls = [hull_around(link.mesh, self._hull_m) for link in robot.links] if robot else []
        # With their backs: a link that points at the camera has a depth as large as its length.
        self._drawing = LinkDrawing(intrinsics, hulls, inflate=True, farthest=True)
        self._is_shown = False
        self.padding_m = np.full(len(hulls), padding_m, np.float32)
        self.near_raw = np.full(intrinsics.shape, limits.RAW_MAX, np.uint16)
        self.span_raw = np.zeros(intrinsics.shape, np.uint16)
        self.columns = np.zeros((intrinsics.height, 2), np.int32)
        self.bundle = plain(limits.Band(self.near_raw, self.span_raw, self.columns))

    def forget(self) -> None:
        """Remove the robot: without joints its position is not known, and it is reported, not filtered."""
        limits.clear_band(self.bundle)
        self._is_shown = False

    def draw(
        self,
        T_camera_link: NDArray[np.float64],
        padding_m: NDArray[np.float32],
        noise_per_m: float,
        depth_m: float,
        hidden: NDArray[np.bool_] | None = None,
    ) -> bool:
        """Draw the links at poses (L, 4, 4), each with its padding (L,) m; returns False if none had moved.

        `noise_per_m` and `depth_m`, from the padded surface, widen the band, see `limits.robot_band_raw`.
        `hidden` (L,) links are left out.
        """
        if hidden is not None and hidden.any():
            T_camera_link = T_camera_link.copy()
            # Behind the camera nothing is drawn.
            T_camera_link[hidden, :3, :3] = 0.0
            T_camera_link[hidden, 2, 3] = -1.0
        growth_m = padding_m - np.float32(self._hull_m)
        drawing = self._drawing
        if not drawing.draw(T_camera_link, growth_m, anew=not self._is_shown):
            return False
        limits.robot_band_raw(
            drawing.buffer.bundle,
            drawing.rectangles,
            drawing.all,
            noise_per_m,
            depth_m,
            self._intrinsics.depth_scale_m,
            self.bundle,
        )
        self._is_shown = True
        return True


class BareRobot:
    """The robot without padding: for images and for `expected_depth`, not for the filter."""

    def __init__(self, intrinsics: Intrinsics, robot: Robot | None) -> None:
        meshes = [link.mesh for link in robot.links] if robot else []
        self._drawing = LinkDrawing(intrinsics, meshes, inflate=False)
        self._no_padding_m = np.zeros(len(meshes), np.float32)

    def lower(self, T_camera_link: NDArray[np.float64], depth_m: NDArray[np.float32]) -> None:
        """Lower `depth_m` (H, W) to the links at poses (L, 4, 4) that are nearer."""
        drawing = self._drawing
        drawing.draw(T_camera_link, self._no_padding_m)
        limits.lower_depth(drawing.buffer.bundle, drawing.rectangles, drawing.all, depth_m)
