# SPDX-License-Identifier: Apache-2.0
"""A cell with its robot, people and unknown objects, as a function of time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shared.cell import Cell
from shared.errors import InputError
from shared.meshes import TriangleMesh, box_mesh
from shared.transforms import Transform, from_rotation_translation
from simulation.world.people import Loop, Person
from simulation.world.robot_path import JointPath, RobotPath
from simulation.world.scene import Body, Capsules, Owner, Scene

DEMO_CELL = Path(__file__).resolve().parents[2] / "assets" / "cells" / "demo" / "cell.yaml"

MAX_DEMO_PEOPLE = 2
"""One on either side of the table; a third would walk through them."""


@dataclass(frozen=True, eq=False)
class Thing:
    """An unknown body. It is present from `from_s` until `until_s`, and drifts with `velocity_m_s`."""

    name: str
    mesh: TriangleMesh
    T_world_mesh: Transform
    from_s: float = -math.inf
    until_s: float = math.inf
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def pose_at(self, t_s: float) -> Transform:
        """Return `T_world_mesh` at `t_s`; the given pose is that of time 0."""
        if not any(self.velocity_m_s):
            return self.T_world_mesh
        pose = self.T_world_mesh.copy()
        pose[:3, 3] += np.array(self.velocity_m_s) * t_s
        return pose


@dataclass(frozen=True)
class Absence:
    """A known body of the cell, static or object, that is absent from `from_s` until `until_s`."""

    name: str
    from_s: float = -math.inf
    until_s: float = math.inf


@dataclass(frozen=True, eq=False)
class World:
    """True content of the cell as a pure function of time; `room` surrounds it and never moves."""

    cell: Cell
    robot_path: JointPath | None = None
    people: tuple[Person, ...] = ()
    things: tuple[Thing, ...] = ()
    absences: tuple[Absence, ...] = ()
    room: tuple[Body, ...] = ()

    def __post_init__(self) -> None:
        robot = self.cell.robot
        if robot is not None and self.robot_path is None:
            raise InputError(f"world of cell {self.cell.name}: expected a path for its robot, got none")
        if robot is not None and self.robot_path is not None and len(self.robot_path.home_rad) != robot.joint_count:
            raise InputError(
                f"robot path: expected {robot.joint_count} joints of cell {self.cell.name}, "
                f"got {len(self.robot_path.home_rad)}"
            )
        known = {body.name for body in (*self.cell.static, *self.cell.objects)}
        for absence in self.absences:
            if absence.name not in known:
                raise InputError(f"absence: expected one of {', '.join(sorted(known))}, got {absence.name}")

    @classmethod
    def demo(cls, people: int = 1, seed: int = 0, cell: Cell | None = None) -> World:
        """Return the demo cell with its moving robot and up to two people who walk beside the table.

        `seed` determines each person's stature, speed and place at time 0.

        Raises:
            InputError: there is no room for so many people.
        """
        return cls(cell or Cell.load(DEMO_CELL), RobotPath.demo(), demo_people(people, seed), room=(demo_room(),))

    def with_things(self, *things: Thing) -> World:
        """Return the same world with additional unknown objects."""
        return replace(self, things=(*self.things, *things))

    def joints_at(self, t_s: float) -> NDArray[np.float64] | None:
        """Return joint positions (n,) in rad; None without a robot."""
        return None if self.cell.robot is None or self.robot_path is None else self.robot_path.joints_at(t_s)

    def velocities_at(self, t_s: float) -> NDArray[np.float64] | None:
        """Return joint velocities (n,) in rad/s; None without a robot."""
        return None if self.cell.robot is None or self.robot_path is None else self.robot_path.velocities_at(t_s)

    def scene(self, t_s: float) -> Scene:
        """Return all bodies in the cell at `t_s`."""
        absent = frozenset(gone.name for gone in self.absences if gone.from_s <= t_s < gone.until_s)
        fixed = self._fixed.get(absent)
        if fixed is None:
            fixed = self._fixed[absent] = tuple(body for body in self._known if body.name not in absent)
        moving = [
            Body(thing.name, thing.mesh, thing.pose_at(t_s), Owner.UNKNOWN)
            for thing in self.things
            if thing.from_s <= t_s < thing.until_s
        ]
        robot, joints = self.cell.robot, self.joints_at(t_s)
        if robot is not None and joints is not None:
            poses = robot.T_world_base @ robot.link_poses(joints)
            moving += [Body(link.name, link.mesh, poses[link.index], Owner.ROBOT) for link in robot.links]
        return Scene(fixed, tuple(moving), Capsules.joined([person.capsules(t_s) for person in self.people]))

    @cached_property
    def _known(self) -> tuple[Body, ...]:
        return (
            *self.room,
            *(Body(body.name, body.mesh, body.T_world_mesh, Owner.STATIC) for body in self.cell.static),
            *(Body(body.name, body.mesh, body.T_world_mesh, Owner.OBJECT) for body in self.cell.objects),
        )

    @cached_property
    def _fixed(self) -> dict[frozenset[str], tuple[Body, ...]]:
        """Fixed part of scenes by the absent bodies: at most two to the number of absences."""
        return {}


def demo_people(count: int, seed: int = 0) -> tuple[Person, ...]:
    """Return people who walk along the demo cell's table, the first on its -y side, the second on its +y side.

    Raises:
        InputError: `count` is not 0 to `MAX_DEMO_PEOPLE`.
    """
    if not 0 <= count <= MAX_DEMO_PEOPLE:
        raise InputError(f"people: expected 0 to {MAX_DEMO_PEOPLE}, got {count}")
    rng = np.random.default_rng((seed, 0x50E0))
    found = []
    for side, loop in enumerate(_DEMO_LOOPS[:count]):
        stature_m, speed_m_s, start_s = rng.uniform((1.60, 0.7, 0.0), (1.85, 1.1, 20.0))
        found.append(
            Person(
                loop,
                float(stature_m),
                float(speed_m_s),
                start_s=float(start_s),
                floor_m=_DEMO_FLOOR_M,
                left_handed=side == 1,
            )
        )
    return tuple(found)


def demo_room() -> Body:
    """Return walls and ceiling around the demo cell's floor, outside its box: the background of the cameras' views."""
    T_world_room = from_rotation_translation(np.eye(3), (0.0, 0.0, 1.2))
    return Body("room", box_mesh("room", (6.1, 6.1, 4.2)), T_world_room, Owner.ROOM)


_DEMO_FLOOR_M = -0.75

# Both face the table at their stop, and reach over its end with the arm on the far side from the robot.
_DEMO_LOOPS = (
    Loop(centre_m=(0.50, -0.92), heading_rad=math.pi, straight_m=0.8, radius_m=0.18),
    Loop(centre_m=(0.50, 0.92), heading_rad=0.0, straight_m=0.8, radius_m=0.18),
)
