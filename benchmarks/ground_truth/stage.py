# SPDX-License-Identifier: Apache-2.0
"""A D435i askew to the lattice, a known wall before it, and between the two one thing of a known shape.

Every pixel is a ray cast by Embree, with the faults of the camera on it. No face of a voxel is parallel to the picture,
so that no curve depends on how a flat thing happens to lie between two layers of voxels.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from shared.cell import Cell, PlacedMesh
from shared.meshes import TriangleMesh, box_mesh, cylinder_mesh
from shared.transforms import Transform, apply, from_rotation_translation, from_xyz_rpy
from simulation.cameras.camera import d435i_intrinsics
from simulation.cameras.depth_noise import DepthNoise, DepthSensor
from simulation.cameras.raycast import RaycastRenderer
from simulation.world.people import Loop, Person
from simulation.world.scene import Body, Capsules, Owner, Scene, View

T_WORLD_CAMERA = from_xyz_rpy((0.37, -0.21, 1.13), (0.5, -0.35, 0.8))

CELL_HALF_M = 1.2
"""The cell is a cube about the thing: it holds a person with outstretched arms, and the wall a metre behind."""

WALL_THICK_M = 0.02
WALL_PER_M = 2.6
"""Side of the wall for each metre of its distance: it fills the picture."""

PLACES_M, PLACES_PER_M = 0.25, 0.2
"""Things stand within the first of the optical axis, and nearer to it before a near camera."""

TILT_MAX_RAD = math.radians(60.0)
"""From the picture's plane: a rod that points at the camera shows its end only."""

CYLINDERS = {"rod 10 mm": (0.005, 0.30), "rod 20 mm": (0.01, 0.30), "arm 80 mm": (0.04, 0.40)}
"""Radius and length in metres."""

BOXES = {"cube 50 mm": 0.05, "box 300 mm": 0.30}
"""Edge in metres."""

THINGS = ("rod 10 mm", "rod 20 mm", "cube 50 mm", "arm 80 mm", "box 300 mm", "person")

_MESHES: dict[str, TriangleMesh] = {
    **{name: cylinder_mesh(name, *size) for name, size in CYLINDERS.items()},
    **{name: box_mesh(name, (edge,) * 3) for name, edge in BOXES.items()},
}
_PERSON = Person(Loop((0.0, 0.0), 0.0, 1.0, 0.5))
_UPRIGHT = np.array(((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)))
"""Turns a body whose z is up into the camera's frame, whose y is down."""


class Stage:
    """A thing at `distance_m` (its middle), and a known wall `behind_m` farther."""

    def __init__(self, distance_m: float, behind_m: float, noise: DepthNoise, seed: int) -> None:
        self.distance_m = distance_m
        self.noise = noise
        self.intrinsics = d435i_intrinsics()
        self.T_world_camera = T_WORLD_CAMERA
        wall_m = distance_m + behind_m
        side_m = WALL_PER_M * (wall_m + WALL_THICK_M)
        mesh = box_mesh("wall", (side_m, side_m, WALL_THICK_M))
        pose = T_WORLD_CAMERA @ from_xyz_rpy((0.0, 0.0, wall_m + 0.5 * WALL_THICK_M), (0.0, 0.0, 0.0))
        middle = apply(T_WORLD_CAMERA, np.array((0.0, 0.0, distance_m)))
        wall = PlacedMesh("wall", mesh, pose)
        self.cell = Cell("accuracy", middle - CELL_HALF_M, middle + CELL_HALF_M, (wall,))
        self._fixed = (Body("wall", mesh, pose, Owner.STATIC),)
        self._renderer = RaycastRenderer(self.intrinsics, T_WORLD_CAMERA)
        self._sensor = DepthSensor(self.intrinsics, noise, seed)
        self._moment = 0

    def frame(self, bodies: tuple[Body, ...]) -> tuple[NDArray[np.uint16], View]:
        """The next frame (H, W) with `bodies` on the stage, and what a perfect camera would see of them."""
        self._moment += 1
        view = self._renderer.render(Scene(self._fixed, bodies, Capsules.joined([])))
        return self._sensor.measure(view.z_m, self._moment), view

    def place(self, thing: str, rng: np.random.Generator, tilt_max_rad: float = TILT_MAX_RAD) -> tuple[Body, ...]:
        """The thing of that name (see `THINGS`) at another place, turned another way each time.

        A cylinder's axis lies within `tilt_max_rad` of the picture's plane, boxes are turned in any way, a person
        stands upright and is met anywhere on his way.
        """
        reach_m = min(PLACES_M, PLACES_PER_M * self.distance_m)
        middle = np.array((*rng.uniform(-reach_m, reach_m, 2), self.distance_m))
        if thing == "person":
            return self._person(rng, middle)
        rotation = _any_turn(rng) if thing in BOXES else _lying(rng, tilt_max_rad)
        pose = T_WORLD_CAMERA @ from_rotation_translation(rotation, middle)
        return (Body(thing, _MESHES[thing], pose, Owner.UNKNOWN),)

    @staticmethod
    def _person(rng: np.random.Generator, middle: NDArray[np.float64]) -> tuple[Body, ...]:
        found = _PERSON.capsules(rng.uniform(0.0, _PERSON.lap_s))
        ends_m = np.concatenate((found.a_m, found.b_m))
        centre = 0.5 * (ends_m.min(axis=0) + ends_m.max(axis=0))
        T_world_person: Transform = T_WORLD_CAMERA @ from_rotation_translation(_UPRIGHT, middle - _UPRIGHT @ centre)
        a_m, b_m = apply(T_world_person, found.a_m), apply(T_world_person, found.b_m)
        return Capsules(a_m, b_m, found.radius_m, found.owner).bodies()


def _lying(rng: np.random.Generator, tilt_max_rad: float) -> NDArray[np.float64]:
    """A rotation (3, 3) that lays z near the picture's plane."""
    heading, tilt = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.0, tilt_max_rad)
    axis = np.array((math.cos(tilt) * math.cos(heading), math.cos(tilt) * math.sin(heading), math.sin(tilt)))
    side = np.array((-math.sin(heading), math.cos(heading), 0.0))
    return np.stack((np.cross(side, axis), side, axis), axis=1)


def _any_turn(rng: np.random.Generator) -> NDArray[np.float64]:
    """A rotation (3, 3), all equally likely."""
    matrix, triangle = np.linalg.qr(rng.standard_normal((3, 3)))
    matrix = matrix * np.sign(np.diag(triangle))
    return np.asarray(matrix if np.linalg.det(matrix) > 0.0 else -matrix)
