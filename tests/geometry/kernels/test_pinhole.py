# SPDX-License-Identifier: Apache-2.0
"""The kernels' projection against that of `shared.camera`, in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.kernels.pinhole import Camera, deproject, in_32, moved, nearest_pixel, project, rows_of, rows_of_32
from shared.camera import Intrinsics
from shared.transforms import apply, from_xyz_rpy

CAMERA = Intrinsics(61, 43, 50.0, 52.0, 29.7, 21.2)
LENS = Camera(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.width, CAMERA.height)
T = from_xyz_rpy((0.3, -0.2, 0.7), (0.4, -1.1, 2.5))
POINTS_M = np.random.default_rng(0).uniform((-1.0, -1.0, 0.2), (1.0, 1.0, 3.0), (200, 3))


def test_moved_equals_the_transform() -> None:
    there_m = np.array([moved(rows_of(T), *point) for point in POINTS_M])
    np.testing.assert_allclose(there_m, apply(T, POINTS_M), atol=1e-12)


def test_float32_stays_float32() -> None:
    points_m = POINTS_M.astype(np.float32)
    there_m = np.array([moved(rows_of_32(T), *point) for point in points_m])
    np.testing.assert_allclose(there_m, apply(T, points_m.astype(np.float64)), atol=1e-6)
    x, y, z = points_m[0]
    found = project(x, y, np.float32(1.0) / z, in_32(LENS))
    for place, exact in zip(found, CAMERA.project(POINTS_M[:1])[0], strict=True):
        assert place == pytest.approx(exact, abs=1e-4)


def test_projection_equals_the_camera_and_is_inverted() -> None:
    pixels = np.array([project(x, y, 1.0 / z, LENS) for x, y, z in POINTS_M])
    np.testing.assert_allclose(pixels, CAMERA.project(POINTS_M), atol=1e-9)
    back_m = np.array([deproject(u, v, z, LENS) for (u, v), z in zip(pixels, POINTS_M[:, 2], strict=True)])
    np.testing.assert_allclose(back_m, POINTS_M, atol=1e-12)


def test_pixel_centres_are_at_integers() -> None:
    assert project(0.0, 0.0, 1.0, LENS) == (CAMERA.cx, CAMERA.cy)
    for pixel in (-3, 0, 7):
        assert [nearest_pixel(pixel + part) for part in (-0.51, -0.5, -0.49, 0.0, 0.49, 0.5)] == [
            pixel - 1, pixel, pixel, pixel, pixel, pixel + 1,
        ]  # fmt: skip
        assert nearest_pixel(np.float32(pixel + 0.25)) == pixel
