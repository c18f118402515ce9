# SPDX-License-Identifier: Apache-2.0
"""A world is a pure function of time."""

from __future__ import annotations

import numpy as np
import pytest

from shared.cell import Cell
from shared.errors import InputError
from shared.meshes import box_mesh
from shared.transforms import from_xyz_rpy, identity
from simulation.world.robot_path import RobotPath
from simulation.world.scene import Owner
from simulation.world.world import DEMO_CELL, Absence, Thing, World

BOX = box_mesh("box", (0.1, 0.1, 0.1))


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(DEMO_CELL)


def names(world: World, t_s: float) -> set[str]:
    return {body.name for body in world.scene(t_s).bodies()}


def test_equal_worlds_give_equal_scenes(cell: Cell) -> None:
    first, second = (World.demo(people=2, seed=5, cell=cell) for _ in range(2))
    second.scene(99.0)
    for ours, theirs in zip(first.scene(12.3).bodies(), second.scene(12.3).bodies(), strict=True):
        assert ours.name == theirs.name
        np.testing.assert_array_equal(ours.T_world_mesh, theirs.T_world_mesh)


def test_owners_of_all_bodies(cell: Cell) -> None:
    owners = {body.name: body.owner for body in World.demo(people=1, cell=cell).scene(0.0).bodies()}
    assert owners["table"] == Owner.STATIC
    assert owners["tray"] == Owner.OBJECT
    assert owners["tool"] == Owner.ROBOT
    assert owners["room"] == Owner.ROOM
    assert owners["capsule 0"] == Owner.PERSON


def test_the_fixed_part_is_the_same_tuple_until_something_leaves(cell: Cell) -> None:
    world = World(cell, RobotPath.demo(), absences=(Absence("tray", 2.0, 5.0), Absence("shelf", 4.0)))
    assert world.scene(0.0).fixed is world.scene(1.9).fixed
    assert "tray" in names(world, 1.9)
    assert "tray" not in names(world, 2.0)
    assert world.scene(2.0).fixed is world.scene(3.9).fixed
    assert names(world, 5.0) == names(world, 0.0) - {"shelf"}


def test_unknown_objects_appear_drift_and_disappear(cell: Cell) -> None:
    thing = Thing("part", BOX, from_xyz_rpy((1.0, 0.0, 0.5), (0.0, 0.0, 0.3)), 1.0, 3.0, (0.0, 0.1, 0.0))
    world = World(cell, RobotPath.demo()).with_things(thing)
    assert "part" not in names(world, 0.9)
    assert "part" not in names(world, 3.0)
    (part,) = (body for body in world.scene(2.0).bodies() if body.name == "part")
    assert part.owner == Owner.UNKNOWN
    np.testing.assert_allclose(part.T_world_mesh, from_xyz_rpy((1.0, 0.2, 0.5), (0.0, 0.0, 0.3)))
    np.testing.assert_allclose(thing.T_world_mesh[:3, 3], (1.0, 0.0, 0.5))


def test_a_cell_without_a_robot_has_no_joints() -> None:
    world = World(Cell("empty", np.zeros(3), np.ones(3)), things=(Thing("part", BOX, identity()),))
    assert world.joints_at(1.0) is None
    assert world.velocities_at(1.0) is None
    assert names(world, 1.0) == {"part"}


def test_inconsistent_worlds_are_refused(cell: Cell) -> None:
    with pytest.raises(InputError, match="expected a path for its robot"):
        World(cell)
    with pytest.raises(InputError, match="expected 6 joints of cell demo, got 3"):
        World(cell, RobotPath.still((0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="absence: expected one of floor, shelf, table, tray, got ghost"):
        World(cell, RobotPath.demo(), absences=(Absence("ghost"),))
