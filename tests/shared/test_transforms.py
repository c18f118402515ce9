# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from shared import transforms
from shared.errors import InputError

Triple = tuple[float, float, float]

lengths = st.floats(-100.0, 100.0)
triples = st.tuples(lengths, lengths, lengths)
angles = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)
poses = st.builds(transforms.from_xyz_rpy, triples, angles)
directions = triples.filter(lambda v: np.linalg.norm(v) > 1e-3)


def is_rigid(matrix: NDArray[np.float64]) -> bool:
    rotation = matrix[:3, :3]
    return bool(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) and np.linalg.det(rotation) > 0.0)


@given(poses)
def test_inverse_cancels(pose: NDArray[np.float64]) -> None:
    np.testing.assert_allclose(pose @ transforms.inverse(pose), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(transforms.inverse(pose), np.linalg.inv(pose), atol=1e-9)


@given(poses, poses, triples)
def test_frames_chain(T_a_b: NDArray[np.float64], T_b_c: NDArray[np.float64], point: Triple) -> None:
    p_c = np.array(point)
    p_a = transforms.apply(T_a_b, transforms.apply(T_b_c, p_c))
    np.testing.assert_allclose(transforms.apply(T_a_b @ T_b_c, p_c), p_a, atol=1e-8)
    np.testing.assert_allclose((T_a_b @ T_b_c @ np.append(p_c, 1.0))[:3], p_a, atol=1e-8)


@given(directions, st.floats(-10.0, 10.0))
def test_rotation_about_keeps_its_axis_and_turns_by_its_angle(axis: Triple, angle: float) -> None:
    rotation = transforms.rotation_about(axis, angle)
    assert is_rigid(transforms.from_rotation_translation(rotation, (0, 0, 0)))
    unit = np.array(axis) / np.linalg.norm(axis)
    np.testing.assert_allclose(rotation @ unit, unit, atol=1e-9)
    across = np.cross(unit, np.add(np.roll(unit, 1), (0.3, -0.2, 0.1)))
    assume(np.linalg.norm(across) > 1e-2)
    across /= np.linalg.norm(across)
    expected = math.cos(angle) * across + math.sin(angle) * np.cross(unit, across)
    np.testing.assert_allclose(rotation @ across, expected, atol=1e-9)


def test_rotation_about_a_zero_axis_is_the_identity() -> None:
    np.testing.assert_array_equal(transforms.rotation_about((0, 0, 0), 1.0), np.eye(3))


def test_quarter_turns_are_right_handed() -> None:
    x, y, z = np.eye(3)
    for axis, before, after in ((z, x, y), (x, y, z), (y, z, x)):
        np.testing.assert_allclose(transforms.rotation_about(axis, math.pi / 2) @ before, after, atol=1e-12)


def test_rpy_turns_about_the_fixed_axes_roll_first() -> None:
    # Roll lifts y to z; the pitch that follows takes z to x; no yaw.
    T = transforms.from_xyz_rpy((1, 2, 3), (math.pi / 2, math.pi / 2, 0.0))
    np.testing.assert_allclose(transforms.apply(T, np.array([0.0, 1.0, 0.0])), [2, 2, 3], atol=1e-12)
    T = transforms.from_xyz_rpy((0, 0, 0), (0.0, math.pi / 2, math.pi / 2))
    np.testing.assert_allclose(transforms.apply(T, np.array([0.0, 0.0, 1.0])), [0, 1, 0], atol=1e-12)


@given(st.floats(0.0, math.pi), directions, triples)
def test_angle_is_that_of_the_rotation(angle: float, axis: Triple, shift: Triple) -> None:
    T = transforms.from_rotation_translation(transforms.rotation_about(axis, angle), shift)
    assert transforms.angle_rad(T) == pytest.approx(angle, abs=1e-7)


@given(triples, triples, directions)
def test_look_at_is_an_optical_frame(eye: Triple, target: Triple, up: Triple) -> None:
    forward = np.subtract(target, eye)
    assume(np.linalg.norm(forward) > 1e-2)
    T_world_camera = transforms.look_at(eye, target, up)
    assert is_rigid(T_world_camera)
    in_camera = transforms.apply(transforms.inverse(T_world_camera), np.array(target))
    np.testing.assert_allclose(in_camera, np.array([0.0, 0.0, np.linalg.norm(forward)]), atol=1e-6)
    # The up direction of the world is up in the image: minus y.
    assert (np.array(up) / np.linalg.norm(up)) @ T_world_camera[:3, 1] <= 1e-6


def test_look_at_straight_down_and_at_itself() -> None:
    T = transforms.look_at((0, 0, 2), (0, 0, 0))
    assert is_rigid(T)
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1])
    np.testing.assert_allclose(T[:3, 1], [0, -1, 0])
    assert is_rigid(transforms.look_at((0, 0, 0), (0, 1, 0), (0, 1, 0)))
    with pytest.raises(InputError, match="expected a target away from the eye"):
        transforms.look_at((1, 1, 1), (1, 1, 1))


def test_apply_keeps_the_shape_of_point_arrays() -> None:
    points = np.arange(24.0).reshape(2, 4, 3)
    T = transforms.from_xyz_rpy((1, 0, 0), (0, 0, math.pi / 2))
    result = transforms.apply(T, points)
    assert result.shape == (2, 4, 3)
    np.testing.assert_allclose(result[1, 2], [1.0 - points[1, 2, 1], points[1, 2, 0], points[1, 2, 2]])


@given(poses)
def test_validated_returns_a_copy(pose: NDArray[np.float64]) -> None:
    checked = transforms.validated(pose.tolist(), "T")
    np.testing.assert_array_equal(checked, pose)
    assert transforms.validated(pose, "T") is not pose


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (np.eye(3), r"T_a_b: expected a 4x4 matrix, got shape \(3, 3\)"),
        ("pose", "T_a_b: expected a 4x4 matrix of numbers, got str"),
        ([[1.0], [1.0, 2.0]], "T_a_b: expected a 4x4 matrix of numbers, got list"),
        (np.full((4, 4), np.nan), "T_a_b: expected finite numbers"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "T_a_b: expected the last row 0 0 0 1"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), r"with determinant -1\.000"),
        (np.diag([1.0, 1.0, 1.001, 1.0]), "T_a_b: expected a right-handed rotation"),
        (np.diag([0.001, 0.001, 0.001, 1.0]), "T_a_b: expected a right-handed rotation"),
    ],
)
def test_invalid_poses_are_refused(value: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        transforms.validated(value, "T_a_b")


def test_pose_with_few_digits_is_accepted() -> None:
    written = np.round(transforms.from_xyz_rpy((0.1, 0.2, 0.3), (0.4, 0.5, 0.6)), 5)
    taken = transforms.validated(written, "T")
    np.testing.assert_allclose(taken, written, atol=1e-5)
    np.testing.assert_allclose(taken[:3, :3] @ taken[:3, :3].T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(("decimals", "off", "notable"), [(6, 2e-6, False), (4, 2e-4, True), (3, 2e-3, True)])
def test_any_pose_of_few_decimals_becomes_the_nearest_rotation(decimals: int, off: float, notable: bool) -> None:
    random = np.random.default_rng(3)
    warned = 0
    for _ in range(300):
        rotation = transforms.rotation_about(random.normal(size=3), random.uniform(0.0, np.pi))
        pose = transforms.from_rotation_translation(rotation, random.uniform(-2.0, 2.0, 3))
        written = np.round(pose, decimals)
        taken = transforms.validated(written, "T")
        np.testing.assert_allclose(taken, pose, atol=off)
        np.testing.assert_allclose(transforms.inverse(taken) @ taken, np.eye(4), atol=1e-14)
        warned += transforms.rounding_warning(written, taken) is not None
    assert (warned > 270) if notable else (warned == 0)


def test_an_exact_pose_is_left_digit_by_digit() -> None:
    pose = transforms.from_xyz_rpy((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    np.testing.assert_array_equal(transforms.validated(pose, "T"), pose)
    assert transforms.rounding_warning(pose, transforms.validated(pose, "T")) is None


@pytest.mark.parametrize("off", [1e-8, -3e-7, 1e-6])
def test_rounding_in_the_last_row_is_removed(off: float) -> None:
    """Rounding of an inverse in float32, in each of the four entries."""
    pose = transforms.from_xyz_rpy((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    for column in range(4):
        rounded = pose.copy()
        rounded[3, column] += off * (1.0 - 1e-9)
        np.testing.assert_array_equal(transforms.validated(rounded, "T"), pose)
        assert rounded[3, column] != pose[3, column]


def test_a_last_row_that_is_off_by_more_than_rounding_is_refused_with_its_values() -> None:
    for column in range(4):
        skewed = np.eye(4)
        skewed[3, column] += 2e-6
        with pytest.raises(InputError, match="expected the last row 0 0 0 1, got ") as refused:
            transforms.validated(skewed, "T_a_b")
        assert str(skewed[3].tolist()) in str(refused.value)
