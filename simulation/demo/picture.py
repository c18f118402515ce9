# SPDX-License-Identifier: Apache-2.0
"""The README's picture: the view of one camera of the demo cell, and the merged map of all units.

`python -m simulation.demo.picture FILE.png`. It is painted from the depth of our own renderer, so that no graphics
library is required.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.lattice import Lattice
from shared.meshes import TriangleMesh
from shared.transforms import Transform, apply, look_at
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.cameras.raster import RasterRenderer
from simulation.world.scene import Body, Capsules, Owner, Scene, View
from simulation.world.world import World

WIDTH, HEIGHT = 640, 480
"""Size of each half, in pixels."""

OVERSAMPLING = 2
"""Factor by which it is painted larger and then averaged, for smooth edges."""

MOMENT_S = 69.4
"""At this moment the person leans over the table's end, beside the robot."""

BYTES_MAX = 300_000
"""Limit of the file; a README is also read over slow lines."""

GAP_PX = 10

# Blue, green, red, as in OpenCV.
PAPER = (250, 248, 246)
INK = np.array((60, 52, 46))
COLOURS = {
    Owner.STATIC: (206, 203, 200),
    Owner.OBJECT: (168, 196, 156),
    Owner.ROBOT: (190, 132, 74),
    Owner.PERSON: (64, 126, 240),
    Owner.UNKNOWN: (64, 126, 240),
}
WITNESS_COLOURS = ((150, 196, 250), (96, 160, 246), (48, 116, 236), (24, 78, 204))
"""Colours of a voxel that one, two, three, four or more units report."""

LIGHT = np.array((0.45, 0.35, 0.8))
"""Direction towards the light, world frame."""

FLOOR_GRID_M = 0.5
TEXT_SCALE = 0.55
"""Scale of OpenCV's letters, before averaging."""

CUBE_CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
CUBE_FACES = np.array(
    [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
     (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
)  # fmt: skip
"""Indices of the corners above, counter-clockwise from outside."""

Colours: TypeAlias = NDArray[np.float64]


def main(arguments: Sequence[str] | None = None) -> int:
    """Paint the picture; exit code 1 if the file would be too large."""
    parser = argparse.ArgumentParser(
        prog="python -m simulation.demo.picture", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("file", type=Path, metavar="FILE.png")
    path = parser.parse_args(arguments).file
    encoded, data = cv2.imencode(".png", picture(), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not encoded or data.nbytes > BYTES_MAX:
        print(f"picture: expected at most {BYTES_MAX} bytes, got {data.nbytes}", file=sys.stderr)
        return 1
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.tobytes())
    return 0


def picture() -> NDArray[np.uint8]:
    """Return both halves, (H, W, 3) uint8."""
    world = replace(World.demo(), room=())
    poses = rig(world.cell)
    lattice, keys, witnesses = merged_map(world, MOMENT_S)
    scene = world.scene(MOMENT_S)
    left = Painter(_intrinsics(0.66), poses[1])
    right = Painter(_intrinsics(0.85), look_at((2.45, 1.75, 1.5), (0.05, -0.3, 0.05)))
    halves = (
        left.finish(left.paint(scene), "one camera's view"),
        right.finish(
            right.paint_voxels(scene, lattice, keys, witnesses),
            f"the master's map: {len(keys)} voxels of {1000 * lattice.voxel_size_m:.0f} mm",
        ),
    )
    gap = np.full((HEIGHT, GAP_PX, 3), 255, np.uint8)
    return np.concatenate((halves[0], gap, halves[1]), axis=1)


def merged_map(world: World, t_s: float) -> tuple[Lattice, NDArray[np.uint32], NDArray[np.int64]]:
    """Return the units' merged map of one moment: keys (N,) on the lattice, and the number of units for each."""
    intrinsics = d435i_intrinsics(424, 240)
    reports = []
    for index, pose in enumerate(rig(world.cell)):
        frame = SimulatedCamera(world, pose, intrinsics, seed=index).capture(t_s)
        voxels = DepthPipeline(intrinsics, pose, world.cell).process(frame.depth, frame.joints).voxels
        reports.append(voxels.keys)
    keys, witnesses = np.unique(np.concatenate(reports), return_counts=True)
    return voxels.lattice, keys, witnesses


class Painter:
    """Paint scenes as seen from one pose."""

    def __init__(self, intrinsics: Intrinsics, T_world_camera: Transform) -> None:
        self._intrinsics = intrinsics
        self._T_world_camera = T_world_camera
        self._renderer = RasterRenderer(intrinsics, T_world_camera)
        y, x = np.indices(intrinsics.shape)
        across, down = (x - intrinsics.cx) / intrinsics.fx, (y - intrinsics.cy) / intrinsics.fy
        self._rays = np.stack((across, down, np.ones(intrinsics.shape)), axis=-1)

    def paint(self, scene: Scene) -> Colours:
        """Paint a scene."""
        view = self._renderer.render(scene)
        return self._shade(view, self._base(view))

    def paint_voxels(
        self, scene: Scene, lattice: Lattice, keys: NDArray[np.uint32], witnesses: NDArray[np.int64]
    ) -> Colours:
        """Paint a scene with the voxels of a map instead of its people."""
        cubes = Body("map", voxel_mesh(lattice, keys), np.eye(4), Owner.UNKNOWN)
        view = self._renderer.render(Scene(scene.fixed, (*scene.moving, cubes), Capsules.joined([])))
        base = self._base(view)
        points, normals = self._points(view), self._normals(view)
        voxel = view.owner == Owner.UNKNOWN
        # Just below the surface, to be surely inside.
        inside = (points - 0.1 * lattice.voxel_size_m * normals)[voxel]
        found = np.searchsorted(keys, lattice.keys(lattice.index(inside)))
        count = witnesses[np.minimum(found, len(keys) - 1)]
        base[voxel] = np.array(WITNESS_COLOURS)[np.minimum(count, len(WITNESS_COLOURS)) - 1]
        shares = (inside - lattice.origin_m) / lattice.voxel_size_m % 1.0
        to_border = np.minimum(shares, 1.0 - shares)
        # Across the face, the border is the same for all its pixels; the nearer of the other two is the line.
        to_border[np.arange(len(inside)), np.abs(normals[voxel]).argmax(axis=-1)] = 1.0
        line = to_border.min(axis=-1) * lattice.voxel_size_m < view.z_m[voxel] / self._intrinsics.fx
        base[voxel] = np.where(line[:, None], 0.72 * base[voxel], base[voxel])
        return self._shade(view, base)

    def finish(self, colours: Colours, caption: str) -> NDArray[np.uint8]:
        """Average down to (HEIGHT, WIDTH, 3) uint8, and add a caption."""
        image = np.clip(colours, 0.0, 255.0).astype(np.uint8)
        origin = (14 * OVERSAMPLING, 26 * OVERSAMPLING)
        cv2.putText(
            image, caption, origin, cv2.FONT_HERSHEY_DUPLEX, TEXT_SCALE * OVERSAMPLING, INK.tolist(), OVERSAMPLING,
            cv2.LINE_AA,
        )  # fmt: skip
        return np.asarray(cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)

    def _base(self, view: View) -> Colours:
        """Return colours (H, W, 3) by owner, with a grid on the floor."""
        base = np.empty((*view.owner.shape, 3))
        base[:] = PAPER
        for owner, colour in COLOURS.items():
            base[view.owner == owner] = colour
        points = self._points(view)
        floor = (view.owner == Owner.STATIC) & (points[..., 2] < -0.74)
        base[floor] = (226, 224, 222)
        offsets = np.abs(points[..., :2] / FLOOR_GRID_M - np.rint(points[..., :2] / FLOOR_GRID_M)).min(axis=-1)
        line = floor & (offsets * FLOOR_GRID_M < 0.7 * view.z_m / self._intrinsics.fx)
        base[line] = (204, 202, 200)
        return base

    def _shade(self, view: View, base: Colours) -> Colours:
        """Add light from one side, and lines where one object ends before another."""
        normals = self._normals(view)
        light = LIGHT / np.linalg.norm(LIGHT)
        brightness = 0.62 + 0.38 * np.clip(normals @ light, -0.4, 1.0)
        painted = base * np.where(view.owner == Owner.NOTHING, 1.0, brightness)[..., None]
        ink = self._edges(view)
        painted[ink] = 0.45 * painted[ink] + 0.55 * INK
        return painted

    def _edges(self, view: View) -> NDArray[np.bool_]:
        """Return the pixels (H, W) beside which another surface begins."""
        z = np.where(np.isfinite(view.z_m), view.z_m, 100.0)
        edges = np.zeros(z.shape, np.bool_)
        for axis in (0, 1):
            step = np.abs(np.diff(1.0 / z, n=2, axis=axis)) * self._intrinsics.fx > 3.5
            changes = np.diff(view.owner, axis=axis) != 0
            middle, low = [slice(None)] * 2, [slice(None)] * 2
            middle[axis], low[axis] = slice(1, -1), slice(None, -1)
            edges[tuple(middle)] |= step
            edges[tuple(low)] |= changes
        return edges

    def _points(self, view: View) -> NDArray[np.float64]:
        """Return world points (H, W, 3)."""
        z = np.where(np.isfinite(view.z_m), view.z_m, 0.0)
        return apply(self._T_world_camera, self._rays * z[..., None])

    def _normals(self, view: View) -> NDArray[np.float64]:
        """Return normals (H, W, 3) in the world frame, from the flatter side of each pixel."""
        camera = self._intrinsics
        z = np.where(np.isfinite(view.z_m), view.z_m, 100.0).astype(np.float64)
        # 1/z is linear on the screen: its gradient is the plane's normal.
        w = 1.0 / z
        slopes = []
        for axis, focal_px in ((1, camera.fx), (0, camera.fy)):
            step = np.diff(w, axis=axis)
            before = np.concatenate((step.take([0], axis), step), axis)
            after = np.concatenate((step, step.take([-1], axis)), axis)
            slopes.append(np.where(np.abs(before) < np.abs(after), before, after) * focal_px)
        a, b = slopes
        normal = np.stack((a, b, w - a * self._rays[..., 0] - b * self._rays[..., 1]), axis=-1)
        normal /= -np.linalg.norm(normal, axis=-1, keepdims=True)
        return np.asarray(normal @ self._T_world_camera[:3, :3].T)


def voxel_mesh(lattice: Lattice, keys: NDArray[np.uint32]) -> TriangleMesh:
    """Return a mesh with a cube for each key."""
    corners = lattice.indices(keys).astype(np.float64)[:, None] + CUBE_CORNERS
    faces = CUBE_FACES + len(CUBE_CORNERS) * np.arange(len(keys))[:, None, None]
    vertices_m = lattice.origin_m + lattice.voxel_size_m * corners.reshape(-1, 3)
    return TriangleMesh("map", vertices_m.astype(np.float32), faces.reshape(-1, 3).astype(np.int32), closed=True)


def _intrinsics(focal_share: float) -> Intrinsics:
    """Return the intrinsics of one half; `focal_share` is the focal length as a share of the width."""
    width, height = WIDTH * OVERSAMPLING, HEIGHT * OVERSAMPLING
    focal_px = focal_share * width
    return Intrinsics(width, height, focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1))


if __name__ == "__main__":
    sys.exit(main())
