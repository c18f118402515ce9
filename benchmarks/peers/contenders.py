# SPDX-License-Identifier: Apache-2.0
"""The same work by Open3D, OctoMap, DUFOMap and Embree, each used as its documentation says, on one thread.

Constants between frames cost the peers nothing: rays, the CAD's expected depth, the margins.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import octomap
import open3d
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from shared.camera import Intrinsics
from shared.cell import Cell
from shared.meshes import TriangleMesh
from shared.settings import FilterSettings
from shared.transforms import Transform, apply, inverse

o3d: Any = open3d
"""Typed as Any, because the stubs of Open3D accept fewer array types than Open3D does."""

PEERS = {
    "Open3D": "no margin that grows beside edges, no robot of two sides, no density filter, nothing of what is seen.",
    "OctoMap": "is given filtered points, so it pays for no robot, no CAD and no density filter; it does more in that "
    "it casts rays and keeps probabilities of occupied and free.",
    "DUFOMap": "is given the same points; it does more in that it marks the free space before them in UFOMap's octree, "
    "but keeps no probabilities.",
    "Embree": "only the expected depth, by exact rays.",
}
"""Differences of each contender's work from that of the filter beside it."""

FAR_M = 60.0
"""Depth limit in metres: more than Open3D can shorten uint16 millimetres to."""


class Camera:
    """Rays of a camera, and the depths that they should see of the CAD."""

    def __init__(self, intrinsics: Intrinsics, T_world_camera: Transform, cell: Cell) -> None:
        assert cell.robot is not None
        self.intrinsics = intrinsics
        self.robot = cell.robot
        self.T_world_camera = T_world_camera
        self.T_camera_world = inverse(T_world_camera)
        v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
        x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
        # With z = 1 the ray's parameter at a hit is the depth along the optical axis.
        self.directions = np.ascontiguousarray(np.stack((x, y, np.ones_like(x)), axis=-1), np.float32)
        self.static = [
            (apply(self.T_camera_world @ body.T_world_mesh, body.mesh.vertices).astype(np.float32), body.mesh.faces)
            for body in (*cell.static, *cell.objects)
        ]

    def links(self, joints: NDArray[np.float64]) -> list[tuple[NDArray[np.float32], NDArray[np.int32]]]:
        """Return vertices in the camera frame and faces of the robot's links."""
        T_camera_link = (self.T_camera_world @ self.robot.T_world_base @ self.robot.link_poses(joints)).astype(
            np.float32
        )
        return [
            (link.mesh.vertices @ pose[:3, :3].T + pose[:3, 3], link.mesh.faces)
            for link, pose in zip(self.robot.links, T_camera_link, strict=True)
        ]

    def points_m(self, depth: NDArray[np.uint16], marked: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the world coordinates (N, 3) of the marked pixels."""
        z_m = depth[marked] * self.intrinsics.depth_scale_m
        return apply(self.T_world_camera, self.directions[marked] * z_m[:, None])


class Open3D:
    """Open3D: RaycastingScene, a comparison in numpy, create_from_depth_image, voxel_down_sample."""

    def __init__(self, camera: Camera, settings: FilterSettings) -> None:
        self._camera = camera
        intrinsics = camera.intrinsics
        origins = np.zeros_like(camera.directions)
        self._rays = o3d.core.Tensor(np.concatenate((origins, camera.directions), axis=-1))
        self._pinhole = o3d.camera.PinholeCameraIntrinsic(
            intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
        )
        self._static_m = self._cast(camera.static)
        self._base_m = np.float32(settings.margin_base_m)
        noise_per_m = intrinsics.disparity_noise_m(settings.stereo_subpixel_px)
        self._noise_per_m = np.float32(settings.margin_noise_gain * noise_per_m)

    def expected_depth(self, joints: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the depth (H, W) in metres of the nearest known surface. The CAD's part is cached; the robot's is cast
        now.
        """
        return np.minimum(self._cast(self._camera.links(joints)), self._static_m)

    def foreground(self, depth: NDArray[np.uint16], expected_m: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return the pixels (H, W) that are nearer than expected by more than a margin."""
        z_m = depth * np.float32(self._camera.intrinsics.depth_scale_m)
        # Depth less its noise, where the noise is symmetric, as in the filter.
        limit_m = expected_m / (np.float32(1.0) + self._noise_per_m * expected_m) - self._base_m
        return np.asarray((z_m > 0.0) & (z_m < limit_m))

    def voxels(self, depth: NDArray[np.uint16], marked: NDArray[np.bool_], voxel_size_m: float) -> int:
        """Return the number of voxels that the marked pixels occupy."""
        image = o3d.geometry.Image(np.where(marked, depth, np.uint16(0)))
        cloud = o3d.geometry.PointCloud.create_from_depth_image(
            image, self._pinhole, self._camera.T_camera_world, 1.0 / self._camera.intrinsics.depth_scale_m, FAR_M
        )
        return len(cloud.voxel_down_sample(voxel_size_m).points)

    def process(self, depth: NDArray[np.uint16], joints: NDArray[np.float64], voxel_size_m: float) -> int:
        """Run all steps."""
        return self.voxels(depth, self.foreground(depth, self.expected_depth(joints)), voxel_size_m)

    def _cast(self, bodies: list[tuple[NDArray[np.float32], NDArray[np.int32]]]) -> NDArray[np.float32]:
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        for vertices, faces in bodies:
            scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces.astype(np.uint32)))
        return np.asarray(scene.cast_rays(self._rays, nthreads=1)["t_hit"].numpy(), dtype=np.float32)


class OctoMap:
    """OctoMap: insertPointCloud into a tree that persists from frame to frame."""

    def __init__(self, camera: Camera, voxel_size_m: float) -> None:
        self._origin_m = np.ascontiguousarray(camera.T_world_camera[:3, 3])
        self._tree = octomap.OcTree(voxel_size_m)

    def insert(self, points_m: NDArray[np.float64], once: bool = False) -> None:
        """Insert points (N, 3) in the world, and the free space before them. `once`: one ray per voxel."""
        self._tree.insertPointCloud(points_m, self._origin_m, discretize=once)


class DUFOMap:
    """DUFOMap on the octree of UFOMap, which persists from frame to frame. One thread, nothing inflated."""

    def __init__(self, camera: Camera, voxel_size_m: float) -> None:
        """Make an empty map. Raises ImportError if the package is not installed."""
        from dufomap import dufomap

        self._pose = np.ascontiguousarray(camera.T_world_camera)
        self._map = dufomap(voxel_size_m, 0.0, 0, num_threads=1)

    def insert(self, points_m: NDArray[np.float64]) -> None:
        """Insert points (N, 3) in the world, and the free space before them."""
        self._map.run(points_m, self._pose, False)

    def in_free_space(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask of those points (N, 3) that lie in free space that a frame has observed."""
        return np.asarray(self._map.segment(points_m, self._pose, False), np.bool_)


class Embree:
    """Embree through embreex: one ray through each pixel centre."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._directions = camera.directions.reshape(-1, 3)
        self._origins = np.zeros_like(self._directions)
        self._links = [EmbreeLink(camera, link.mesh) for link in camera.robot.links]

    def expected_depth(self, joints: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the whole expected depth (H, W) in metres, CAD and robot. The scene is rebuilt for the joints."""
        return self._cast(self.scene(joints, with_cad=True))

    def robot_depth(self, joints: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the depth of the robot alone, as if the CAD's depth were cached."""
        return self._cast(self.scene(joints, with_cad=False))

    def robot_depth_link_by_link(self, joints: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the depth of the robot alone at the lowest cost: one cached scene per link, and no rays outside a
        link's rectangle.
        """
        camera = self._camera
        depth_m = np.full(camera.intrinsics.shape, np.inf, np.float32)
        T_camera_link = camera.T_camera_world @ camera.robot.T_world_base @ camera.robot.link_poses(joints)
        for link, pose in zip(self._links, T_camera_link, strict=True):
            link.lower(pose, depth_m)
        return depth_m

    def scene(self, joints: NDArray[np.float64], with_cad: bool) -> EmbreeScene:
        """Return a scene of everything in the camera frame."""
        scene = EmbreeScene()
        for vertices, faces in self._camera.links(joints) + (self._camera.static if with_cad else []):
            EmbreeMesh(scene, vertices, faces)
        return scene

    def _cast(self, scene: EmbreeScene) -> NDArray[np.float32]:
        depth_m = scene.run(self._origins, self._directions, query="DISTANCE")
        return np.asarray(depth_m, dtype=np.float32).reshape(self._camera.intrinsics.shape)


class EmbreeLink:
    """One link in its own frame. Rays are transformed into that frame."""

    def __init__(self, camera: Camera, mesh: TriangleMesh) -> None:
        self._camera = camera
        self._scene = EmbreeScene()
        EmbreeMesh(self._scene, np.array(mesh.vertices), np.array(mesh.faces))
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        self._corners_m = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)], np.float64)

    def lower(self, T_camera_link: Transform, depth_m: NDArray[np.float32]) -> None:
        """Lower `depth_m` (H, W) to the link, which must lie before the camera."""
        uv = self._camera.intrinsics.project(apply(T_camera_link, self._corners_m))
        first = np.maximum(np.floor(uv.min(axis=0)), 0).astype(int)
        last = np.ceil(uv.max(axis=0)).astype(int)
        area = np.s_[first[1] : last[1] + 1, first[0] : last[0] + 1]
        T_link_camera = inverse(T_camera_link)
        directions = (self._camera.directions[area] @ T_link_camera[:3, :3].T.astype(np.float32)).reshape(-1, 3)
        origins = np.broadcast_to(T_link_camera[:3, 3].astype(np.float32), directions.shape).copy()
        found_m = self._scene.run(origins, np.ascontiguousarray(directions), query="DISTANCE")
        part = depth_m[area]
        np.minimum(part, np.asarray(found_m, np.float32).reshape(part.shape), out=part)
