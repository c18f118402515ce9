# SPDX-License-Identifier: Apache-2.0
"""True depth by casting a ray through each pixel centre with Embree; it shares no code with any rasterizer.

Fixed bodies are cast once. Each mesh that moves keeps its own Embree scene in its own frame, and the rays of the pixels
that its bounding box covers are transformed into that frame. That is cheaper than building a scene for each frame.
"""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from shared.camera import Intrinsics
from shared.meshes import TriangleMesh
from shared.transforms import Transform, apply, inverse
from simulation.world.scene import Body, Scene, View

MAX_SCENES = 256
"""Limit of Embree scenes kept: a robot's links and the limbs of a dozen people; about 20 MB."""


class RaycastRenderer:
    """Cast the rays of one camera into scenes."""

    def __init__(self, intrinsics: Intrinsics, T_world_camera: Transform) -> None:
        self._intrinsics = intrinsics
        self._T_world_camera = T_world_camera
        v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
        x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
        # With z = 1 the ray's parameter at a hit is the depth along the optical axis.
        self._directions_camera = np.stack((x, y, np.ones_like(x)), axis=-1)
        self._fixed: tuple[Body, ...] | None = None
        self._fixed_view = View(np.empty(0, np.float32), np.empty(0, np.uint8))
        self._ready: OrderedDict[int, tuple[TriangleMesh, EmbreeScene]] = OrderedDict()

    def render(self, scene: Scene) -> View:
        """See `Renderer`."""
        if scene.fixed is not self._fixed:
            view = View(
                np.full(self._intrinsics.shape, np.inf, dtype=np.float32),
                np.zeros(self._intrinsics.shape, dtype=np.uint8),
            )
            for body in scene.fixed:
                self._cast(body, view)
            self._fixed, self._fixed_view = scene.fixed, view
        view = View(self._fixed_view.z_m.copy(), self._fixed_view.owner.copy())
        for body in (*scene.moving, *scene.capsules.bodies()):
            self._cast(body, view)
        return view

    def _cast(self, body: Body, view: View) -> None:
        """Cast the rays that may meet `body`, and keep hits nearer than those in `view`."""
        T_mesh_camera = inverse(body.T_world_mesh) @ self._T_world_camera
        area = self._area(body.mesh, inverse(T_mesh_camera))
        if area is None:
            return
        directions = (self._directions_camera[area] @ T_mesh_camera[:3, :3].T).astype(np.float32)
        origins = np.broadcast_to(T_mesh_camera[:3, 3].astype(np.float32), directions.shape)
        z_m = self._embree(body.mesh).run(
            np.ascontiguousarray(origins.reshape(-1, 3)), directions.reshape(-1, 3), query="DISTANCE"
        )
        z_m = np.asarray(z_m, dtype=np.float32).reshape(directions.shape[:2])
        nearer = z_m < np.minimum(view.z_m[area], _MISS_M)
        view.z_m[area][nearer] = z_m[nearer]
        view.owner[area][nearer] = body.owner

    def _embree(self, mesh: TriangleMesh) -> EmbreeScene:
        found = self._ready.get(id(mesh))
        if found is None:
            scene = EmbreeScene()
            EmbreeMesh(scene, np.array(mesh.vertices), np.array(mesh.faces))
            # A reference to the mesh is kept, so that no other can get its id.
            found = self._ready[id(mesh)] = (mesh, scene)
            if len(self._ready) > MAX_SCENES:
                self._ready.popitem(last=False)
        else:
            self._ready.move_to_end(id(mesh))
        return found[1]

    def _area(self, mesh: TriangleMesh, T_camera_mesh: Transform) -> tuple[slice, slice] | None:
        """Return the rows and columns that the mesh's bounding box covers, or None if it is out of view."""
        corners = _box_corners(mesh)
        points = apply(T_camera_mesh, corners)
        if points[:, 2].max() <= 0.0:
            return None
        height, width = self._intrinsics.shape
        if points[:, 2].min() <= _BEFORE_CAMERA_M:
            return slice(0, height), slice(0, width)
        pixels = self._intrinsics.project(points)
        first = np.maximum(np.floor(pixels.min(axis=0)).astype(int), 0)
        last = np.minimum(np.ceil(pixels.max(axis=0)).astype(int), (width - 1, height - 1))
        if (first > last).any():
            return None
        return slice(first[1], last[1] + 1), slice(first[0], last[0] + 1)


_MISS_M = np.float32(1e6)
"""Distance above which a hit is a miss: Embree reports 1e37 for a ray without a hit."""

_BEFORE_CAMERA_M = 1e-3
"""A box nearer than this, or partly behind the camera, may cover the whole image."""


def _box_corners(mesh: TriangleMesh) -> NDArray[np.float64]:
    low, high = mesh.bounds_m
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
