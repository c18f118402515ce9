# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.pipeline.fit_check import Health, HealthCheck
from shared.settings import FilterSettings
from tests.edge_unit.scenes import Depth, camera, measured

CAMERA = camera(320, 180)
NO_ROBOT = np.full(CAMERA.shape, 65535, np.uint16)
WALL_M = np.full(CAMERA.shape, 1.5, np.float32)
SETTINGS = FilterSettings()


def check(depth: Depth, static_m: NDArray[np.float32] = WALL_M, robot: NDArray[np.uint16] = NO_ROBOT) -> Health:
    return HealthCheck(CAMERA).check(depth, measured(static_m, CAMERA), robot, SETTINGS)


def test_a_camera_that_sees_the_expected_depth() -> None:
    rng = np.random.default_rng(0)
    health = check(measured(WALL_M + rng.normal(0.0, 0.005, CAMERA.shape), CAMERA))
    assert health.valid_share == 1.0
    assert health.static_share == 1.0
    assert health.agreeing_share > 0.99
    assert abs(health.residual_share) < 0.05


def test_a_covered_lens_is_invalid_or_disagrees() -> None:
    assert check(np.zeros(CAMERA.shape, np.uint16)) == Health(0.0, 0.0, 0.0, 0.0)
    tape = check(np.full(CAMERA.shape, 150, np.uint16))
    assert tape.valid_share == 1.0
    assert tape.agreeing_share == 0.0


def test_a_camera_that_was_knocked_disagrees() -> None:
    """A wall at an angle to the expected one, 60 cm from end to end."""
    tilt = np.linspace(-0.3, 0.3, CAMERA.width, dtype=np.float32)
    assert check(measured(WALL_M + tilt, CAMERA)).agreeing_share < 0.8


def test_a_shift_shows_in_the_residual() -> None:
    sigma_m = CAMERA.disparity_noise_m(SETTINGS.stereo_subpixel_px) * 1.5**2
    margin_m = SETTINGS.margin_base_m + SETTINGS.margin_noise_gain * sigma_m
    for part in (-0.5, 0.25):
        health = check(measured(WALL_M + part * margin_m, CAMERA))
        assert health.agreeing_share == 1.0
        assert health.residual_share == pytest.approx(part, abs=0.05)


def test_the_residual_is_the_median() -> None:
    """Most of the image is farther than expected, the rest nearer; outliers do not count."""
    depth = np.full(CAMERA.shape, 1500, np.uint16)
    depth[:, :120] -= 20
    depth[:, 120:300] += 30
    depth[:, 300:] = 3000
    health = check(depth)
    assert 0.1 < health.residual_share < 0.5
    assert health.agreeing_share == pytest.approx(300 / 320, abs=0.03)


def test_the_robot_and_the_unknown_are_left_out() -> None:
    half_unknown = WALL_M.copy()
    half_unknown[:, :160] = np.inf
    some_depth = np.full(CAMERA.shape, 1500, np.uint16)
    some_depth[:, :160] = 700
    health = check(some_depth, half_unknown)
    assert health.agreeing_share == 1.0
    assert health.static_share == pytest.approx(0.5, abs=0.05)
    robot = NO_ROBOT.copy()
    robot[:, :160] = 600
    assert check(some_depth, WALL_M, robot).agreeing_share == 1.0
    assert check(some_depth, np.full_like(WALL_M, np.inf)).static_share == 0.0


def test_surfaces_too_far_for_16_bits_are_unknown() -> None:
    assert check(np.full(CAMERA.shape, 1500, np.uint16), np.full_like(WALL_M, 70.0)).static_share == 0.0


def test_another_static_layer_is_taken_in() -> None:
    checker = HealthCheck(CAMERA)
    depth = np.full(CAMERA.shape, 1500, np.uint16)
    assert checker.check(depth, measured(WALL_M, CAMERA), NO_ROBOT, SETTINGS).agreeing_share == 1.0
    assert checker.check(depth, measured(WALL_M + 1.0, CAMERA), NO_ROBOT, SETTINGS).agreeing_share == 0.0
    assert checker.check(depth, measured(WALL_M, CAMERA), NO_ROBOT, SETTINGS).agreeing_share == 1.0
