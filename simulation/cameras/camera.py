# SPDX-License-Identifier: Apache-2.0
"""A depth camera in the world, and the positions of a cell's cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from shared.camera import Intrinsics
from shared.cell import Cell
from shared.errors import InputError
from shared.transforms import Transform, look_at
from simulation.cameras.depth_noise import DepthNoise, DepthSensor
from simulation.cameras.raster import RasterRenderer
from simulation.world.scene import Renderer, View
from simulation.world.world import World

RendererName = Literal["raster", "raycast"]

D435I_FOCAL_PX = {(424, 240): 213.0, (640, 480): 385.0, (848, 480): 425.0, (1280, 720): 640.0}
"""Depth profiles of a D435i and their focal lengths: about 87 degrees wide; 640x480 is cut out of a wider image."""

MAX_RIG = 50
"""Limit of cameras: as many as the largest cells have."""

RIG_OUTSIDE_M = 0.15
"""Distance of the cameras outside the cell's box."""

MOMENTS_PER_S = 1_000_000
"""Resolution of a frame's time: frames less than a microsecond apart have the same noise."""


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """A frame with its ground truth.

    Attributes:
        depth: (H, W) uint16 as the camera measures it, in units of depth_scale_m.
        view: the view of a perfect camera: true depth and owner.
        joints: (n,) rad at the frame's time; None without a robot.
    """

    depth: NDArray[np.uint16]
    view: View
    joints: NDArray[np.float64] | None

    @property
    def true_z_m(self) -> NDArray[np.float32]:
        """True depth (H, W) float32 in metres, inf for pixels without a surface."""
        return self.view.z_m

    @property
    def owner(self) -> NDArray[np.uint8]:
        """Owner of each pixel's surface (H, W), see `Owner`."""
        return self.view.owner


class SimulatedCamera:
    """A fixed depth camera in a world. Equal arguments give equal frames."""

    def __init__(
        self,
        world: World,
        T_world_camera: Transform,
        intrinsics: Intrinsics,
        noise: DepthNoise | None = None,
        renderer: RendererName = "raster",
        seed: int = 0,
    ) -> None:
        self.world = world
        self.T_world_camera = T_world_camera
        self.intrinsics = intrinsics
        self.noise = noise or DepthNoise()
        self._renderer: Renderer = _renderer(renderer, intrinsics, T_world_camera)
        self._sensor = DepthSensor(intrinsics, self.noise, seed)

    def look(self, t_s: float) -> View:
        """Return the view of a perfect camera at `t_s`."""
        return self._renderer.render(self.world.scene(t_s))

    def capture(self, t_s: float) -> SimulatedFrame:
        """Return the frame taken at `t_s`, with its ground truth."""
        view = self.look(t_s)
        depth = self._sensor.measure(view.z_m, round(t_s * MOMENTS_PER_S))
        return SimulatedFrame(depth, view, self.world.joints_at(t_s))


def _renderer(name: RendererName, intrinsics: Intrinsics, T_world_camera: Transform) -> Renderer:
    if name == "raster":
        return RasterRenderer(intrinsics, T_world_camera)
    # Embree does not exist for ARM boards, where a simulated camera can replace a real one.
    from simulation.cameras.raycast import RaycastRenderer

    return RaycastRenderer(intrinsics, T_world_camera)


def d435i_intrinsics(width: int = 848, height: int = 480) -> Intrinsics:
    """Return the intrinsics of a D435i's depth stream.

    Raises:
        InputError: the camera has no such profile.
    """
    focal_px = D435I_FOCAL_PX.get((width, height))
    if focal_px is None:
        known = ", ".join(f"{w}x{h}" for w, h in D435I_FOCAL_PX)
        raise InputError(f"resolution: expected one of {known}, got {width}x{height}")
    return Intrinsics(width, height, focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1))


def rig(cell: Cell, count: int = 4) -> tuple[Transform, ...]:
    """Return `T_world_camera` of `count` cameras around a cell's box, directed into it from above.

    The first four are at its upper corners, opposite ones first. More cameras fill the gaps between them, every other
    four lower. A rig of fewer cameras is the first part of a larger one.

    Raises:
        InputError: `count` is not 1 to `MAX_RIG`.
    """
    if not 1 <= count <= MAX_RIG:
        raise InputError(f"cameras: expected 1 to {MAX_RIG}, got {count}")
    low, high = cell.box_min_m, cell.box_max_m
    size = high - low
    target = low + size * (0.5, 0.5, 0.4)
    corners = np.array(((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])))
    middle = 0.5 * (low + high)[:2]
    corners += RIG_OUTSIDE_M * np.sign(corners - middle)
    poses = []
    for index in range(count):
        side, share = divmod(4.0 * _halving(index), 1.0)
        here, there = corners[int(side)], corners[(int(side) + 1) % 4]
        height_m = high[2] - (0.0 if index // 4 % 2 == 0 else 0.35 * size[2])
        poses.append(look_at((*(here + share * (there - here)), height_m), target))
    return tuple(poses)


def _halving(index: int) -> float:
    """Return 0, 1/2, 1/4, 3/4, 1/8 ...: each number is in the largest gap (van der Corput)."""
    value, step = 0.0, 0.5
    while index:
        value += step * (index & 1)
        index >>= 1
        step *= 0.5
    return value
