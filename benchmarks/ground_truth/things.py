# SPDX-License-Identifier: Apache-2.0
"""A stage askew to the lattice with a known wall on it, and things of known shapes in front of the wall.

No face of a voxel is parallel to the image plane. So no curve depends on the position of a flat thing between two
layers of voxels.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from benchmarks.sweep_scenes.stage import SLAB_THICK_M, Stage, lying, slab
from shared.cell import Cell
from shared.meshes import TriangleMesh, box_mesh, cylinder_mesh
from shared.transforms import Transform, apply, from_rotation_translation, from_xyz_rpy
from simulation.cameras.depth_noise import DepthNoise
from simulation.world.people import Loop, Person
from simulation.world.scene import Body, Capsules, Owner

T_WORLD_CAMERA = from_xyz_rpy((0.37, -0.21, 1.13), (0.5, -0.35, 0.8))

CELL_HALF_M = 1.2
"""Half the edge of the cell, a cube about the thing. It holds a person with outstretched arms and a wall 1 m behind."""

WALL_PER_M = 2.6
"""Side of the wall per metre of its distance: it fills the image."""

PLACES_M, PLACES_PER_M = 0.25, 0.2
"""Things stand within the first value of the optical axis, and closer to it if the camera is near."""

TILT_MAX_RAD = math.radians(60.0)
"""Maximum tilt from the image plane. A rod that points at the camera shows only its end."""

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
"""Turns a body whose z axis points up into the camera's frame, whose y axis points down."""


def before_wall(distance_m: float, behind_m: float, noise: DepthNoise, seed: int) -> Stage:
    """Return a stage for a thing whose centre is at `distance_m`, with a known wall `behind_m` farther."""
    wall_m = distance_m + behind_m
    pose = T_WORLD_CAMERA @ from_xyz_rpy((0.0, 0.0, wall_m + 0.5 * SLAB_THICK_M), (0.0, 0.0, 0.0))
    wall = slab("wall", WALL_PER_M * (wall_m + SLAB_THICK_M), pose)
    middle = apply(T_WORLD_CAMERA, np.array((0.0, 0.0, distance_m)))
    cell = Cell("accuracy", middle - CELL_HALF_M, middle + CELL_HALF_M, (wall,))
    return Stage(T_WORLD_CAMERA, cell, noise, seed)


def placed(
    thing: str, distance_m: float, rng: np.random.Generator, tilt_max_rad: float = TILT_MAX_RAD
) -> tuple[Body, ...]:
    """Return the thing of that name (see `THINGS`) at a random place and in a random orientation.

    The axis of a cylinder lies within `tilt_max_rad` of the image plane. Boxes are turned in any way. A person stands
    upright, anywhere on his way.
    """
    reach_m = min(PLACES_M, PLACES_PER_M * distance_m)
    middle = np.array((*rng.uniform(-reach_m, reach_m, 2), distance_m))
    if thing == "person":
        return _person(rng, middle)
    if thing in BOXES:
        rotation = _any_turn(rng)
    else:
        rotation = lying(rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.0, tilt_max_rad))
    pose = T_WORLD_CAMERA @ from_rotation_translation(rotation, middle)
    return (Body(thing, _MESHES[thing], pose, Owner.UNKNOWN),)


def _person(rng: np.random.Generator, middle: NDArray[np.float64]) -> tuple[Body, ...]:
    found = _PERSON.capsules(rng.uniform(0.0, _PERSON.lap_s))
    ends_m = np.concatenate((found.a_m, found.b_m))
    centre = 0.5 * (ends_m.min(axis=0) + ends_m.max(axis=0))
    T_world_person: Transform = T_WORLD_CAMERA @ from_rotation_translation(_UPRIGHT, middle - _UPRIGHT @ centre)
    a_m, b_m = apply(T_world_person, found.a_m), apply(T_world_person, found.b_m)
    return Capsules(a_m, b_m, found.radius_m, found.owner).bodies()


def _any_turn(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a random rotation (3, 3), all equally likely."""
    matrix, triangle = np.linalg.qr(rng.standard_normal((3, 3)))
    matrix = matrix * np.sign(np.diag(triangle))
    return np.asarray(matrix if np.linalg.det(matrix) > 0.0 else -matrix)
