# SPDX-License-Identifier: Apache-2.0
"""The faults of the simulated camera have the measured strength, and each can be switched off."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from shared.camera import Intrinsics
from simulation.cameras.depth_noise import DepthNoise, DepthSensor, grow_near, smooth_field

CAMERA = Intrinsics(160, 120, 425.0, 425.0, 79.5, 59.5, depth_scale_m=0.0001)
"""A D435i at 848x480, cut out, with a fine depth unit so that rounding hides nothing."""

MEASURED_MM = ((0.7, 1.0, 4.8), (1.0, 1.5, 8.7), (1.5, 2.0, 21.0), (2.0, 3.0, 33.0))
"""Median standard deviation of depth over static pixels of real frames, by range of depth in metres."""


def only(**faults: object) -> DepthNoise:
    """Return a configuration with only these faults."""
    return DepthNoise.model_validate({**DepthNoise.none().model_dump(), **faults})


def plane(z_m: float, camera: Intrinsics = CAMERA) -> NDArray[np.float32]:
    return np.full(camera.shape, z_m, dtype=np.float32)


def step(near_m: float, far_m: float, camera: Intrinsics = CAMERA) -> NDArray[np.float32]:
    """Return the view of a post at `near_m` in the middle of a wall at `far_m`."""
    z_m = plane(far_m, camera)
    z_m[:, camera.width // 2 - 20 : camera.width // 2 + 20] = near_m
    return z_m


def measured(
    noise: DepthNoise, z_m: NDArray[np.float32], frames: int = 1, camera: Intrinsics = CAMERA, seed: int = 0
) -> NDArray[np.float64]:
    """Return depth (frames, H, W) in metres, NaN for pixels without a measurement."""
    sensor = DepthSensor(camera, noise, seed)
    raw = np.stack([sensor.measure(z_m, moment) for moment in range(frames)])
    return np.where(raw == 0, np.nan, raw * camera.depth_scale_m)


@pytest.mark.parametrize(("low_m", "high_m", "sigma_mm"), MEASURED_MM)
def test_noise_is_as_measured_on_real_frames(low_m: float, high_m: float, sigma_mm: float) -> None:
    noise = DepthNoise(hole_share=0.0)
    deviations = []
    for z_m in np.linspace(low_m, high_m, 9):
        depth_m = measured(noise, plane(z_m), frames=24)
        assert np.nanmean(depth_m) == pytest.approx(z_m, rel=0.01)
        deviations.append(float(np.nanmedian(np.nanstd(depth_m, axis=0, ddof=1))))
    assert np.median(deviations) * 1000.0 == pytest.approx(sigma_mm, rel=0.15)


def test_noise_is_normal_and_as_configured_at_the_nodes_of_the_table() -> None:
    noise = DepthNoise(hole_share=0.0, disparity_step_px=0.0)
    error_m = measured(noise, plane(1.25), frames=40) - 1.25
    assert error_m.std() == pytest.approx(0.0087, rel=0.03)
    assert (np.abs(error_m - error_m.mean()) < error_m.std()).mean() == pytest.approx(0.683, abs=0.01)


def test_noise_of_constant_disparity_grows_as_the_focal_length_shrinks() -> None:
    coarse = Intrinsics(160, 120, 215.0, 215.0, 79.5, 59.5, depth_scale_m=0.0001)
    noise = only(sigma_gain=1.0, sigma_focal_px=430.0)
    z_m = np.array((0.5, 1.25, 2.0))
    np.testing.assert_allclose(noise.sigma_of(z_m, coarse), 2.0 * DepthNoise().sigma_of(z_m, coarse))
    error_m = measured(noise, plane(1.25, coarse), frames=20, camera=coarse) - 1.25
    assert error_m.std() == pytest.approx(0.0174, rel=0.05)


def test_beyond_the_table_noise_grows_with_the_square_of_depth() -> None:
    noise = DepthNoise()
    near, far = noise.sigma_of(np.array((0.4, 0.8)), CAMERA), noise.sigma_of(np.array((5.0, 10.0)), CAMERA)
    np.testing.assert_allclose((near[1] / near[0], far[1] / far[0]), 4.0)


def test_noise_is_smooth_over_a_few_pixels_and_new_in_each_frame() -> None:
    error_m = measured(DepthNoise(hole_share=0.0), plane(1.2), frames=30) - 1.2

    def correlation(shift: int) -> float:
        return float((error_m[:, :, shift:] * error_m[:, :, : 160 - shift]).mean() / (error_m**2).mean())

    assert 0.8 < correlation(1) < 0.95
    assert 0.35 < correlation(6) < 0.65
    assert abs(correlation(20)) < 0.05
    assert abs((error_m[1:] * error_m[:-1]).mean() / (error_m**2).mean()) < 0.05


def test_disparity_comes_in_steps() -> None:
    depth_m = measured(only(sigma_gain=1.0, disparity_step_px=1.0 / 32.0), plane(2.5), frames=4)
    steps = 425.0 * 0.05 / depth_m * 32.0
    np.testing.assert_allclose(steps, np.round(steps), atol=0.02)
    assert len(np.unique(np.round(steps))) > 5


def test_a_perfect_camera_only_rounds() -> None:
    z_m = step(0.9, 3.1)
    np.testing.assert_allclose(measured(DepthNoise.none(), z_m)[0], z_m, atol=CAMERA.depth_scale_m * 0.51)


def test_points_too_near_too_far_or_absent_are_not_measured() -> None:
    noise = only(disparity_max_px=126.0, range_max_m=4.0)
    nearest_m = 425.0 * 0.05 / 126.0
    for z_m, seen in ((nearest_m - 0.001, False), (nearest_m + 0.001, True), (3.999, True), (4.001, False)):
        assert np.isfinite(measured(noise, plane(z_m))).all() == seen
        assert np.isfinite(measured(noise, plane(z_m))).any() == seen
    assert np.isnan(measured(DepthNoise(), plane(math.inf))).all()
    too_deep_for_16_bits = plane(6.6)
    assert np.isnan(measured(DepthNoise.none(), too_deep_for_16_bits)).all()


@pytest.mark.parametrize("near_m", [0.8, 1.2, 2.0])
def test_near_objects_grow_by_about_thirty_millimetres_at_their_own_depth(near_m: float) -> None:
    z_m = step(near_m, 3.5)
    grown = np.abs(measured(only(halo_m=0.03, halo_ragged=0.4), z_m, frames=30) - near_m) < 0.01
    rows = slice(20, 100)
    wider_px = grown[:, rows].sum(axis=2) - 40
    width_m = wider_px / 2.0 * near_m / 425.0
    assert np.median(width_m) == pytest.approx(0.03, abs=0.004)
    assert width_m.std() > 0.001
    assert (width_m < 0.03 * 1.4 + near_m / 425.0).all()


def test_the_halo_covers_only_the_background() -> None:
    z_m = plane(2.0)
    z_m[30:60, 40:80] = 1.0
    z_m[:, 90:] = np.inf
    depth_m = measured(only(halo_m=0.03, halo_ragged=0.0), z_m)[0]
    np.testing.assert_allclose(depth_m[30:60, 40:80], 1.0, atol=1e-3)
    assert np.nanmin(depth_m) > 0.999
    np.testing.assert_allclose(depth_m[0, 90:96], 2.0, atol=1e-3)
    assert np.isnan(depth_m[0, 100:]).all()


def test_growth_equals_the_twin() -> None:
    rng = np.random.default_rng(3)
    z_m = rng.choice(np.array((0.8, 1.0, 1.02, 2.0, np.inf), dtype=np.float32), (24, 30), p=(0.02, 0.1, 0.1, 0.68, 0.1))
    field = rng.normal(size=z_m.shape).astype(np.float32)
    halo_px_m, ragged = 3.2, 0.5
    expected = z_m.copy()
    for (y, x), z in np.ndenumerate(z_m):
        behind = np.float32(z * 1.04 + 0.03)
        beside = [z_m[j, i] for j, i in ((y, x - 1), (y, x + 1), (y - 1, x), (y + 1, x)) if 0 <= j < 24 and 0 <= i < 30]
        if not max(beside) > behind:
            continue
        for (row, column), other in np.ndenumerate(z_m):
            reach = halo_px_m / float(z) * (1.0 + ragged * min(max(0.5 * float(field[row, column]), -1.0), 1.0))
            if other > behind and math.hypot(row - y, column - x) <= reach:
                expected[row, column] = min(expected[row, column], z)
    grown = z_m.copy()
    grow_near(z_m, field, halo_px_m, ragged, grown)
    np.testing.assert_array_equal(grown, expected)
    assert (grown != z_m).sum() > 50


def test_near_objects_have_a_shadow_on_the_left_as_wide_as_the_disparities_differ() -> None:
    depth_m = measured(only(shadow=True), step(1.0, 2.0))[0]
    width_px = round(425.0 * 0.05 * (1.0 / 1.0 - 1.0 / 2.0))
    hidden = np.isnan(depth_m).all(axis=0)
    assert hidden.sum() == np.isnan(depth_m).any(axis=0).sum()
    assert abs(hidden.sum() - width_px) <= 1
    assert hidden[59]
    assert not hidden[60:].any()
    assert not hidden[: 60 - width_px - 1].any()


def test_a_share_of_the_pixels_at_edges_flies_between_the_surfaces() -> None:
    depth_m = measured(only(flying_share=0.3, flying_px=2), step(1.0, 2.0), frames=20)
    at_edge = np.zeros(160, dtype=bool)
    for edge in (60, 100):
        at_edge[edge - 2 : edge + 2] = True
    between = (depth_m > 1.001) & (depth_m < 1.999)
    assert between[:, :, at_edge].mean() == pytest.approx(0.3, abs=0.03)
    assert not between[:, :, ~at_edge].any()
    assert np.isfinite(depth_m).all()


def test_surfaces_at_a_grazing_angle_fade() -> None:
    v = (np.arange(120) - 59.5)[:, None] / 425.0

    def unseen(incidence_deg: float) -> float:
        """Share of holes in the middle of a plane that is turned by `incidence_deg` about the camera's x axis."""
        slope = math.tan(math.radians(incidence_deg))
        z_m = np.broadcast_to(1.5 / (1.0 - slope * v * 0.2), CAMERA.shape)
        # Only rows near the middle have this incidence; the factor keeps the others in front of the camera.
        middle = np.where(np.abs(v) < 0.02, 1.5 / (1.0 - slope * v), z_m).astype(np.float32)
        return float(np.isnan(measured(only(grazing_from_deg=80.0), middle, frames=4)[:, 55:65]).mean())

    assert unseen(70.0) == 0.0
    assert 0.25 < unseen(85.0) < 0.75
    assert unseen(85.0) < unseen(88.0)


def test_holes_have_the_configured_share_and_mostly_stay_in_place() -> None:
    large = Intrinsics(848, 480, 425.0, 425.0, 423.5, 239.5)
    noise = only(hole_share=0.02)
    holes = np.isnan(measured(noise, plane(1.5, large), frames=12, camera=large))
    others = np.isnan(measured(noise, plane(1.5, large), frames=12, camera=large, seed=1))
    assert holes.mean() == pytest.approx(0.02, abs=0.008)
    assert holes[0][holes[1]].mean() > 10.0 * holes[0][others[1]].mean()
    # In blobs: a pixel beside a hole is most likely one as well.
    assert holes[:, :, 1:][holes[:, :, :-1]].mean() > 0.8


def test_equal_seeds_and_moments_give_equal_frames() -> None:
    z_m = step(1.0, 2.5)
    first, second = DepthSensor(CAMERA, DepthNoise(), 7), DepthSensor(CAMERA, DepthNoise(), 7)
    first.measure(z_m, 1)
    np.testing.assert_array_equal(first.measure(z_m, 123456), second.measure(z_m, 123456))
    assert (first.measure(z_m, 123457) != second.measure(z_m, 123456)).mean() > 0.5
    assert (DepthSensor(CAMERA, DepthNoise(), 8).measure(z_m, 1) != first.measure(z_m, 1)).mean() > 0.5
    assert first.measure(z_m, -5).any()


def test_a_field_is_linear_between_its_nodes_and_of_unit_variance_everywhere() -> None:
    rng = np.random.default_rng(0)
    total, total2, rounds = np.zeros((20, 33)), np.zeros((20, 33)), 4000
    field = np.empty((20, 33), dtype=np.float32)
    grid = np.empty((20 // 4 + 2, 33 // 8 + 2), dtype=np.float32)
    for _ in range(rounds):
        grid[:] = rng.normal(size=grid.shape)
        smooth_field(grid, 4, 8, field)
        total += field
        total2 += field.astype(np.float64) ** 2
    np.testing.assert_allclose(total / rounds, 0.0, atol=0.08)
    np.testing.assert_allclose(total2 / rounds, 1.0, atol=0.12)
    np.testing.assert_allclose(field[::4, ::8], grid[:5, :5], rtol=1e-6)
    np.testing.assert_allclose(field[2, 12], grid[0:2, 1:3].mean() * 2.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("bad", "text"),
    [
        ({"sigma_m": (0.1,)}, "sigma_m"),
        ({"sigma_at_m": (1.0, 0.5), "sigma_m": (0.1, 0.1)}, "rising"),
        ({"sigma_at_m": (1.0, 2.0), "sigma_m": (0.1, 0.0)}, "above 0"),
        ({"halo_m": -0.1}, "halo_m"),
        ({"halo": 0.1}, "halo"),
        ({"range_max_m": float("nan")}, "range_max_m"),
    ],
)
def test_a_wrong_configuration_is_refused(bad: dict[str, object], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        DepthNoise.model_validate(bad)
