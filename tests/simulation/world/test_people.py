# SPDX-License-Identifier: Apache-2.0
"""People stay on their paths and move without jumps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from shared.errors import InputError
from simulation.world.people import Loop, Person, smooth
from simulation.world.world import World, demo_people

LOOP = Loop(centre_m=(0.3, -0.2), heading_rad=0.7, straight_m=0.8, radius_m=0.2)


def test_a_loop_is_closed_and_walked_at_unit_speed() -> None:
    arcs = np.linspace(0.0, LOOP.length_m, 4001)
    places = np.array([LOOP.at(arc) for arc in arcs])
    steps = np.diff(places[:, :2], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), np.diff(arcs), rtol=1e-3)
    np.testing.assert_allclose(places[0, :2], places[-1, :2], atol=1e-9)
    along = np.arctan2(steps[:, 1], steps[:, 0])
    turned = np.angle(np.exp(1j * (along - places[:-1, 2])))
    assert np.abs(turned).max() < 0.01


def test_the_motion_is_smooth_and_periodic() -> None:
    person = Person(LOOP, speed_m_s=0.9, dwell_s=3.0)
    times = np.linspace(0.0, person.lap_s, 3001)
    arcs, vigour, reach = np.array([person.motion(t) for t in times[:-1]]).T
    walked = np.unwrap(arcs, period=LOOP.length_m)
    speed = np.gradient(walked, times[1] - times[0])
    np.testing.assert_allclose(walked[-1], LOOP.length_m, rtol=1e-6)
    np.testing.assert_allclose(speed[1:-1], 0.9 * vigour[1:-1], atol=0.01)
    assert reach.max() == pytest.approx(1.0)
    assert not (reach[vigour > 0.0]).any()


def test_smooth_begins_and_ends_flat() -> None:
    assert [smooth(x) for x in (-1.0, 0.0, 0.5, 1.0, 2.0)] == [0.0, 0.0, 0.5, 1.0, 1.0]
    assert smooth(1e-4) < 1e-7


@pytest.mark.parametrize("seed", range(8))
def test_people_stay_in_the_box_on_the_floor_and_never_jump(seed: int) -> None:
    world = World.demo(people=2, seed=seed)
    before = None
    step_s = 0.05
    for t_s in np.arange(0.0, 30.0, step_s):
        capsules = world.scene(t_s).capsules
        ends = np.stack((capsules.a_m, capsules.b_m))
        assert np.isfinite(ends).all()
        low = (ends - capsules.radius_m[:, None]).min(axis=(0, 1))
        high = (ends + capsules.radius_m[:, None]).max(axis=(0, 1))
        assert (low[:2] > world.cell.box_min_m[:2]).all()
        assert (high < world.cell.box_max_m).all()
        assert low[2] == pytest.approx(-0.75, abs=1e-9)
        if before is not None:
            # The fastest point is a foot that swings forward in a bend; a jump would be many times faster.
            assert np.linalg.norm(ends - before, axis=-1).max() < 5.0 * step_s
        before = ends


def test_a_person_has_the_given_stature_and_rigid_limbs() -> None:
    lengths = []
    for t_s in np.arange(0.0, 12.0, 0.1):
        capsules = Person(LOOP, stature_m=1.8).capsules(t_s)
        lengths.append(np.linalg.norm(capsules.b_m - capsules.a_m, axis=1))
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], np.shape(lengths)), atol=0.02)
    # The trunk's capsule ends at the neck, which leans; all limbs are rigid.
    np.testing.assert_allclose(np.array(lengths)[:, 5:], np.broadcast_to(lengths[0][5:], (120, 12)), atol=1e-9)
    standing = Person(LOOP, stature_m=1.8, dwell_s=10.0).capsules(-0.01)
    tallest = (standing.b_m[:, 2] + standing.radius_m).max()
    assert tallest == pytest.approx(1.8, abs=0.06)


def test_a_person_reaches_over_the_table_with_the_given_hand() -> None:
    for person, side in zip(demo_people(2), (1.0, -1.0), strict=True):
        middle_of_dwell_s = -person.start_s - 0.5 * person.dwell_s
        capsules = person.capsules(middle_of_dwell_s)
        hands = capsules.b_m[[7, 13]]
        over_table = np.abs(hands[:, 1]) < 0.4
        assert over_table.tolist() == [side < 0, side > 0]
        assert (hands[over_table, 2] > 0.05).all()
        assert math.isclose(person.motion(middle_of_dwell_s)[2], 1.0)


def test_the_seed_determines_people_and_too_many_are_refused() -> None:
    assert demo_people(2, 3) == demo_people(2, 3)
    assert demo_people(2, 3) != demo_people(2, 4)
    assert demo_people(1, 3) == demo_people(2, 3)[:1]
    with pytest.raises(InputError, match="people"):
        demo_people(3)
