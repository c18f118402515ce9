# SPDX-License-Identifier: Apache-2.0
"""Capsules and their meshes."""

from __future__ import annotations

import numpy as np
import pytest

from simulation.world.scene import Capsules, Owner, Scene, capsule_mesh


@pytest.mark.parametrize(("length_m", "radius_m"), [(0.5, 0.1), (0.1, 0.15), (0.0, 0.12)])
def test_a_capsule_mesh_is_closed_and_its_corners_lie_on_the_capsule(length_m: float, radius_m: float) -> None:
    mesh = capsule_mesh(length_m, radius_m)
    points = mesh.vertices.astype(np.float64)
    nearest = np.clip(points[:, 2], 0.0, length_m)
    distance = np.linalg.norm(points - np.stack((0 * nearest, 0 * nearest, nearest), axis=-1), axis=1)
    assert mesh.closed
    np.testing.assert_allclose(distance, radius_m, atol=1e-6)
    low, high = mesh.bounds_m
    np.testing.assert_allclose((low[2], high[2]), (-radius_m, length_m + radius_m), atol=1e-6)


def test_the_body_of_a_capsule_reaches_from_end_to_end() -> None:
    capsules = Capsules(
        np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]),
        np.array([[0.3, 0.4, 0.0], [1.0, 2.0, 3.0]]),
        np.array([0.1, 0.2]),
        np.array([Owner.PERSON, Owner.UNKNOWN], dtype=np.uint8),
    )
    long, round_ = Scene((), (), capsules).bodies()
    np.testing.assert_allclose(long.T_world_mesh @ (0.0, 0.0, 0.5, 1.0), (0.3, 0.4, 0.0, 1.0), atol=1e-12)
    np.testing.assert_allclose(round_.T_world_mesh[:3, 3], (1.0, 2.0, 3.0))
    assert (long.owner, round_.owner) == (Owner.PERSON, Owner.UNKNOWN)


def test_equal_shapes_share_one_mesh() -> None:
    assert capsule_mesh(0.4, 0.05) is capsule_mesh(0.4, 0.05)


def test_no_capsules_are_joined_to_none() -> None:
    assert len(Capsules.joined([])) == 0
