# SPDX-License-Identifier: Apache-2.0
"""True depth, fast: a z-buffer of our own for meshes, and capsules by formula.

Triangles are drawn in homogeneous coordinates (Olano and Greer, "Triangle Scan Conversion using 2D Homogeneous
Coordinates", 1997): corners are projected without division, so triangles that cross the camera's plane need no
clipping. The unit's own rasterizer uses another method, on purpose.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.bundles import plain
from geometry.kernels.jit import kernel
from geometry.kernels.pinhole import Camera
from geometry.rendering.kernel_camera import camera_of
from shared.camera import Intrinsics
from shared.transforms import Transform, inverse
from simulation.world.scene import Body, Scene, View

NEAR_M = 0.02
"""Least depth drawn: nearer points would be inside the camera's housing."""


class Picture(NamedTuple):
    """Buffers: inverse depth `w` (H, W) float32 in 1/m, nothing nearer than `near_m`, and its `owner` (H, W)."""

    w: NDArray[np.float32]
    owner: NDArray[np.uint8]
    near_m: float


class Segments(NamedTuple):
    """Capsules: ends `a_m`, `b_m` (K, 3) in the camera frame, `radius_m` and `label` (K,)."""

    a_m: NDArray[np.float64]
    b_m: NDArray[np.float64]
    radius_m: NDArray[np.float64]
    label: NDArray[np.uint8]


class RasterRenderer:
    """Draw scenes for one camera; fixed bodies are drawn once."""

    def __init__(self, intrinsics: Intrinsics, T_world_camera: Transform) -> None:
        self._camera = camera_of(intrinsics)
        self._T_camera_world = inverse(T_world_camera)
        self._fixed: tuple[Body, ...] | None = None
        self._fixed_w = np.zeros(intrinsics.shape, dtype=np.float32)
        self._fixed_owner = np.zeros(intrinsics.shape, dtype=np.uint8)
        self._corners = np.empty((0, 3))

    def render(self, scene: Scene) -> View:
        """See `Renderer`."""
        if scene.fixed is not self._fixed:
            self._fixed_w[:] = 0.0
            self._fixed_owner[:] = 0
            for body in scene.fixed:
                self._draw(body, self._fixed_w, self._fixed_owner)
            self._fixed = scene.fixed
        w = self._fixed_w.copy()
        owner = self._fixed_owner.copy()
        for body in scene.moving:
            self._draw(body, w, owner)
        pose = self._T_camera_world
        capsules = scene.capsules
        if len(capsules):
            a_camera_m = capsules.a_m @ pose[:3, :3].T + pose[:3, 3]
            b_camera_m = capsules.b_m @ pose[:3, :3].T + pose[:3, 3]
            segments = plain(Segments(a_camera_m, b_camera_m, capsules.radius_m, capsules.owner))
            draw_capsules(segments, self._camera, plain(Picture(w, owner, NEAR_M)))
        to_depth(w)
        return View(w, owner)

    def _draw(self, body: Body, w: NDArray[np.float32], owner: NDArray[np.uint8]) -> None:
        count = len(body.mesh.vertices)
        if count > len(self._corners):
            self._corners = np.empty((count, 3))
        draw_mesh(
            body.mesh.vertices,
            body.mesh.faces,
            self._T_camera_world @ body.T_world_mesh,
            int(body.owner),
            self._camera,
            self._corners,
            plain(Picture(w, owner, NEAR_M)),
        )


@kernel
def draw_mesh(
    vertices_m: NDArray[np.float32],
    faces: NDArray[np.int32],
    T_camera_mesh: NDArray[np.float64],
    label: int,
    camera: Camera,
    corners: NDArray[np.float64],
    picture: Picture,
) -> None:
    """Draw a mesh from both sides.

    `vertices_m` (V, 3), `faces` (F, 3), `T_camera_mesh` (4, 4); `corners` (>= V, 3) is scratch.
    """
    fx, fy, cx, cy, width, height = Camera(*camera)
    w, owner, near_m = Picture(*picture)
    t = T_camera_mesh
    for i in range(len(vertices_m)):
        px, py, pz = vertices_m[i, 0], vertices_m[i, 1], vertices_m[i, 2]
        z = t[2, 0] * px + t[2, 1] * py + t[2, 2] * pz + t[2, 3]
        corners[i, 0] = fx * (t[0, 0] * px + t[0, 1] * py + t[0, 2] * pz + t[0, 3]) + cx * z
        corners[i, 1] = fy * (t[1, 0] * px + t[1, 1] * py + t[1, 2] * pz + t[1, 3]) + cy * z
        corners[i, 2] = z
    w_max = 1.0 / near_m
    for face in range(len(faces)):
        i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
        ax, ay, az = corners[i, 0], corners[i, 1], corners[i, 2]
        bx, by, bz = corners[j, 0], corners[j, 1], corners[j, 2]
        kx, ky, kz = corners[k, 0], corners[k, 1], corners[k, 2]
        nearest = min(az, bz, kz)
        if max(az, bz, kz) < near_m:
            continue
        left, right, top, bottom = 0, width - 1, 0, height - 1
        if nearest >= near_m:
            ua, ub, uc = ax / az, bx / bz, kx / kz
            va, vb, vc = ay / az, by / bz, ky / kz
            left = max(math.ceil(min(ua, ub, uc)), left)
            right = min(math.floor(max(ua, ub, uc)), right)
            top = max(math.ceil(min(va, vb, vc)), top)
            bottom = min(math.floor(max(va, vb, vc)), bottom)
        if left > right or top > bottom:
            continue
        # Edge functions: rows of the adjugate of the matrix of corners; their sum over the determinant is 1/z.
        e0x, e0y, e0w = by * kz - bz * ky, bz * kx - bx * kz, bx * ky - by * kx
        e1x, e1y, e1w = ky * az - kz * ay, kz * ax - kx * az, kx * ay - ky * ax
        e2x, e2y, e2w = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        determinant = ax * e0x + ay * e0y + az * e0w
        if determinant == 0.0:
            continue
        scale = 1.0 / determinant
        e0x, e0y, e0w = e0x * scale, e0y * scale, e0w * scale
        e1x, e1y, e1w = e1x * scale, e1y * scale, e1w * scale
        e2x, e2y, e2w = e2x * scale, e2y * scale, e2w * scale
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                inside0 = e0x * x + e0y * y + e0w
                inside1 = e1x * x + e1y * y + e1w
                inside2 = e2x * x + e2y * y + e2w
                if inside0 >= 0.0 and inside1 >= 0.0 and inside2 >= 0.0:
                    here = np.float32(inside0 + inside1 + inside2)
                    if w[y, x] < here <= w_max:
                        w[y, x] = here
                        owner[y, x] = label


@kernel
def draw_capsules(segments: Segments, camera: Camera, picture: Picture) -> None:
    """Draw capsules."""
    a_camera_m, b_camera_m, radius_m, label = Segments(*segments)
    fx, fy, cx, cy, width, height = Camera(*camera)
    w, owner, near_m = Picture(*picture)
    for i in range(len(radius_m)):
        ax, ay, az = a_camera_m[i, 0], a_camera_m[i, 1], a_camera_m[i, 2]
        bx, by, bz = b_camera_m[i, 0], b_camera_m[i, 1], b_camera_m[i, 2]
        r = radius_m[i]
        nearest = min(az, bz) - r
        if max(az, bz) + r < near_m:
            continue
        left, right, top, bottom = 0, width - 1, 0, height - 1
        if nearest >= near_m:
            # A sphere is inside its box, and a box in front projects farthest at its near or far face.
            u_low = min((ax - r) / max(az - r, near_m), (ax - r) / (az + r))
            u_low = min(u_low, (bx - r) / max(bz - r, near_m), (bx - r) / (bz + r))
            u_high = max((ax + r) / max(az - r, near_m), (ax + r) / (az + r))
            u_high = max(u_high, (bx + r) / max(bz - r, near_m), (bx + r) / (bz + r))
            v_low = min((ay - r) / max(az - r, near_m), (ay - r) / (az + r))
            v_low = min(v_low, (by - r) / max(bz - r, near_m), (by - r) / (bz + r))
            v_high = max((ay + r) / max(az - r, near_m), (ay + r) / (az + r))
            v_high = max(v_high, (by + r) / max(bz - r, near_m), (by + r) / (bz + r))
            left = max(math.ceil(fx * u_low + cx), left)
            right = min(math.floor(fx * u_high + cx), right)
            top = max(math.ceil(fy * v_low + cy), top)
            bottom = min(math.floor(fy * v_high + cy), bottom)
        sx, sy, sz = bx - ax, by - ay, bz - az
        ss = sx * sx + sy * sy + sz * sz
        aa = ax * ax + ay * ay + az * az
        sa = sx * ax + sy * ay + sz * az
        bb = bx * bx + by * by + bz * bz
        for y in range(top, bottom + 1):
            dy = (y - cy) / fy
            for x in range(left, right + 1):
                # The ray is z * (dx, dy, 1), so that its parameter is the depth itself.
                dx = (x - cx) / fx
                dd = dx * dx + dy * dy + 1.0
                ds = dx * sx + dy * sy + sz
                da = dx * ax + dy * ay + az
                z = -1.0
                # The cylinder about the segment: (|s|² dd - ds²) z² - 2 (|s|² da - ds sa) z + |s|² (aa - r²) - sa² = 0.
                p = ss * dd - ds * ds
                if p > 1e-12:
                    q = ss * da - ds * sa
                    under_root = q * q - p * (ss * (aa - r * r) - sa * sa)
                    if under_root < 0.0:
                        # A ray beside the infinite cylinder meets neither of the spheres inside it.
                        continue
                    z = (q - math.sqrt(under_root)) / p
                    along = z * ds - sa
                else:
                    along = -1.0 if ds >= 0.0 else ss + 1.0
                if along < 0.0:
                    under_root = da * da - dd * (aa - r * r)
                    if under_root < 0.0:
                        continue
                    z = (da - math.sqrt(under_root)) / dd
                elif along > ss:
                    db = dx * bx + dy * by + bz
                    under_root = db * db - dd * (bb - r * r)
                    if under_root < 0.0:
                        continue
                    z = (db - math.sqrt(under_root)) / dd
                if z >= near_m:
                    here = np.float32(1.0 / z)
                    if here > w[y, x]:
                        w[y, x] = here
                        owner[y, x] = label[i]


@kernel
def to_depth(w: NDArray[np.float32]) -> None:
    """Convert inverse depth into depth in place: metres, inf for pixels without a surface."""
    height, width = w.shape
    for y in range(height):
        for x in range(width):
            w[y, x] = np.float32(1.0) / w[y, x]
