# SPDX-License-Identifier: Apache-2.0
"""Scenes of the pipeline's tests: cameras, small cells, and true depth by casting rays."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from trimesh.ray.ray_pyembree import RayMeshIntersector

from shared.camera import Intrinsics
from shared.cell import Cell, PlacedMesh
from shared.kinematics import DHJoint, Robot
from shared.meshes import TriangleMesh, box_mesh, cylinder_mesh
from shared.transforms import Transform, apply, from_xyz_rpy, look_at

CHECKOUT = Path(__file__).resolve().parent.parent.parent
DEMO_CELL = CHECKOUT / "assets" / "cells" / "demo" / "cell.yaml"
HOME_RAD = np.array([0.3, -1.3, 1.4, -1.6, -1.5, 0.2])
"""The UR3e of the demo cell with its arm over the table."""

Depth = NDArray[np.uint16]


def camera(width: int = 424, height: int = 240, depth_scale_m: float = 0.001) -> Intrinsics:
    """A D435i's field of view at some resolution, its optical axis a little off the middle."""
    f_px = 645.0 * width / 1280.0
    return Intrinsics(width, height, f_px, 0.99 * f_px, width / 2.0 + 1.3, height / 2.0 - 2.2, depth_scale_m)


@lru_cache(maxsize=1)
def demo_cell() -> Cell:
    """The cell of `make demo`: floor, table, shelf, tray, UR3e."""
    return Cell.load(DEMO_CELL)


ABOVE_TABLE = look_at((1.3, 0.7, 1.0), (0.2, 0.0, 0.25))
"""A camera of the demo cell that has the whole arm in view."""


def placed(name: str, mesh: TriangleMesh, xyz_m: ArrayLike = (0, 0, 0), rpy_rad: ArrayLike = (0, 0, 0)) -> PlacedMesh:
    """A body of a cell."""
    return PlacedMesh(name, mesh, from_xyz_rpy(xyz_m, rpy_rad))


def small_robot() -> Robot:
    """A column that stands, and an arm of 0.4 m that turns about it at half its height."""
    column = box_mesh("column", (0.12, 0.12, 0.4))
    column = TriangleMesh("column", column.vertices + np.float32((0, 0, 0.2)), column.faces, column.closed)
    bar = cylinder_mesh("arm", 0.04, 0.4)
    along_x = apply(from_xyz_rpy((0.2, 0.0, 0.0), (0.0, np.pi / 2, 0.0)), bar.vertices)
    arm = TriangleMesh("arm", along_x, bar.faces, bar.closed)
    return Robot.from_dh([DHJoint("turn", d_m=0.3)], [column, arm], name="small")


def small_cell(robot: bool = True, floor: bool = True) -> Cell:
    """A box of 2 m about a floor at z = 0, a crate that may be moved, and perhaps the small robot."""
    ground = (placed("floor", box_mesh("floor", (2.0, 2.0, 0.02)), (0, 0, -0.01)),)
    crate = (placed("crate", box_mesh("crate", (0.3, 0.2, 0.4)), (0.5, 0.5, 0.2)),)
    return Cell(
        "small",
        np.array((-1.0, -1.0, -0.2)),
        np.array((1.0, 1.0, 1.8)),
        static=ground if floor else (),
        objects=crate if floor else (),
        robot=small_robot() if robot else None,
    )


OVERHEAD = look_at((0.3, -0.2, 1.75), (0.1, 0.0, 0.0))
"""A camera over the small cell."""


def bodies(cell: Cell, joints: ArrayLike | None) -> list[PlacedMesh]:
    """All that is known in a cell, with the robot at `joints`."""
    found = [*cell.static, *cell.objects]
    if cell.robot is not None and joints is not None:
        poses = cell.robot.T_world_base @ cell.robot.link_poses(joints)
        found += [PlacedMesh(link.name, link.mesh, pose) for link, pose in zip(cell.robot.links, poses, strict=True)]
    return found


def raycast(
    things: Sequence[PlacedMesh], T_world_camera: Transform, intrinsics: Intrinsics, farthest: bool = False
) -> NDArray[np.float64]:
    """Depth (H, W) in metres along the optical axis by Embree, a ray through each pixel's integer centre; inf: none.

    Of the nearest surface, or of the `farthest` that the ray goes through.
    """
    v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
    rays = np.stack(((u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(u.shape)), -1)
    depth_m = np.full(u.size, np.inf)
    if things:
        shapes = [trimesh.Trimesh(apply(t.T_world_mesh, t.mesh.vertices), t.mesh.faces, process=False) for t in things]
        directions = rays.reshape(-1, 3) @ T_world_camera[:3, :3].T
        origins = np.broadcast_to(T_world_camera[:3, 3], directions.shape)
        hits_m, ray, _ = RayMeshIntersector(trimesh.util.concatenate(shapes)).intersects_location(
            origins, directions, multiple_hits=farthest
        )
        z_m = (hits_m - T_world_camera[:3, 3]) @ T_world_camera[:3, 2]
        # Ascending, so that of several hits of a ray the last one written is the farthest.
        order = np.argsort(z_m)
        depth_m[ray[order]] = z_m[order]
    return depth_m.reshape(intrinsics.shape)


def measured(depth_m: NDArray[np.floating], intrinsics: Intrinsics) -> Depth:
    """A perfect camera's raw depth: 0 where there is nothing, or it is too far for 16 bits."""
    raw = np.rint(np.nan_to_num(depth_m / intrinsics.depth_scale_m, posinf=0.0))
    return np.where(raw <= 65535, raw, 0).astype(np.uint16)


def grown(mask: NDArray[np.bool_], radius_px: int = 1) -> NDArray[np.bool_]:
    """The mask and all pixels within `radius_px` of it."""
    return np.asarray(ndimage.binary_dilation(mask, np.ones((2 * radius_px + 1,) * 2)))


def shrunk(mask: NDArray[np.bool_], radius_px: int = 1) -> NDArray[np.bool_]:
    """The pixels of the mask that have no other within `radius_px`."""
    return ~grown(~mask, radius_px)
