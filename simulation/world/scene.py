# SPDX-License-Identifier: Apache-2.0
"""All bodies at one moment with their owners, and the view of them that a renderer makes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shared.meshes import TriangleMesh
from shared.transforms import Transform, from_rotation_translation, look_at

CAPSULE_SEGMENTS = 48
"""A torso of 0.15 m radius is then at most 0.4 mm inside the true capsule."""

MAX_CAPSULE_MESHES = 512
"""Limit of meshes kept: 17 a person, so thirty people of different stature."""


class Owner(IntEnum):
    """Owner of the surface that a pixel shows."""

    NOTHING = 0
    STATIC = 1
    OBJECT = 2
    ROBOT = 3
    ROOM = 4
    PERSON = 5
    UNKNOWN = 6


FIRST_UNKNOWN = Owner.PERSON
"""First owner that a unit should report. The room is in no model either, but it is outside the cell's box."""


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh placed in the world."""

    name: str
    mesh: TriangleMesh
    T_world_mesh: Transform
    owner: Owner


@dataclass(frozen=True, eq=False)
class Capsules:
    """Points within `radius_m` (K,) of the segments from `a_m` (K, 3) to `b_m` (K, 3), world, metres, float64.

    `owner` (K,) uint8.
    """

    a_m: NDArray[np.float64]
    b_m: NDArray[np.float64]
    radius_m: NDArray[np.float64]
    owner: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.radius_m)

    @classmethod
    def joined(cls, parts: list[Capsules]) -> Capsules:
        """Return all capsules of `parts`, in their order."""
        if not parts:
            return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0, dtype=np.uint8))
        return cls(
            np.concatenate([part.a_m for part in parts]),
            np.concatenate([part.b_m for part in parts]),
            np.concatenate([part.radius_m for part in parts]),
            np.concatenate([part.owner for part in parts]),
        )

    def bodies(self) -> tuple[Body, ...]:
        """Return the capsules as closed meshes; equal shapes share one mesh."""
        found = []
        for i in range(len(self)):
            a_m, b_m = self.a_m[i], self.b_m[i]
            length_m = float(np.linalg.norm(b_m - a_m))
            # Rounded to the micrometre, so that the next frame finds a limb's mesh again.
            mesh = capsule_mesh(round(length_m, 6), round(float(self.radius_m[i]), 6))
            pose = look_at(a_m, b_m) if length_m > 1e-6 else from_rotation_translation(np.eye(3), a_m)
            found.append(Body(f"capsule {i}", mesh, pose, Owner(int(self.owner[i]))))
        return tuple(found)


@lru_cache(maxsize=MAX_CAPSULE_MESHES)
def capsule_mesh(length_m: float, radius_m: float) -> TriangleMesh:
    """Return a closed mesh of the points within `radius_m` of the segment from the origin to (0, 0, `length_m`)."""
    quarter = CAPSULE_SEGMENTS // 4
    latitude = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 2 * quarter + 1)
    # The equator occurs twice: once at each end of the segment.
    latitude = np.concatenate((latitude[: quarter + 1], latitude[quarter:]))[1:-1]
    along = np.repeat((0.0, length_m), quarter)
    longitude = np.arange(CAPSULE_SEGMENTS) * (2.0 * math.pi / CAPSULE_SEGMENTS)
    rings = np.stack(
        (
            radius_m * np.outer(np.cos(latitude), np.cos(longitude)),
            radius_m * np.outer(np.cos(latitude), np.sin(longitude)),
            np.broadcast_to((along + radius_m * np.sin(latitude))[:, None], (len(latitude), CAPSULE_SEGMENTS)),
        ),
        axis=-1,
    )
    poles = np.array(((0.0, 0.0, -radius_m), (0.0, 0.0, length_m + radius_m)))
    vertices = np.concatenate((rings.reshape(-1, 3), poles))
    south, north = len(vertices) - 2, len(vertices) - 1
    here = np.arange(CAPSULE_SEGMENTS)
    there = (here + 1) % CAPSULE_SEGMENTS
    faces = [np.stack((np.full_like(here, south), there, here), axis=-1)]
    for ring in range(len(latitude) - 1):
        low, high = ring * CAPSULE_SEGMENTS, (ring + 1) * CAPSULE_SEGMENTS
        faces.append(np.stack((low + here, low + there, high + there), axis=-1))
        faces.append(np.stack((low + here, high + there, high + here), axis=-1))
    last = (len(latitude) - 1) * CAPSULE_SEGMENTS
    faces.append(np.stack((last + here, last + there, np.full_like(here, north)), axis=-1))
    return TriangleMesh.of_triangles("capsule", vertices, np.concatenate(faces))


@dataclass(frozen=True, eq=False)
class Scene:
    """All bodies at one moment. `fixed` is the same tuple while nothing in it moves, so that renderers can cache it."""

    fixed: tuple[Body, ...]
    moving: tuple[Body, ...]
    capsules: Capsules

    def bodies(self) -> tuple[Body, ...]:
        """Return all bodies as placed meshes, including capsules."""
        return (*self.fixed, *self.moving, *self.capsules.bodies())


@dataclass(frozen=True, eq=False)
class View:
    """View of a perfect camera: `z_m` (H, W) float32, inf without a surface, and `owner` (H, W) uint8."""

    z_m: NDArray[np.float32]
    owner: NDArray[np.uint8]


class Renderer(Protocol):
    """Draw scenes for one camera. There are two renderers, so that one bug cannot hide in both."""

    def render(self, scene: Scene) -> View:
        """Return true depth along the optical axis and owner, at integer pixel centres, in arrays of the caller."""
        ...
