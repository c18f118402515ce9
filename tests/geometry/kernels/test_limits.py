# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from geometry.kernels import limits
from geometry.kernels.bundles import plain
from geometry.kernels.limits import RAW_MAX, clear_band, lower_depth, nearest_over, robot_band_raw, static_limit_raw
from geometry.kernels.rasterize import LANES, NOTHING_FARTHEST, NOTHING_NEAREST, Buffer

SHAPE = (37, 61)


def static_twin(
    w: NDArray[np.float32],
    reference_m: NDArray[np.float32],
    spread_m: NDArray[np.float32],
    base_m: float,
    noise_per_m: float,
    reference_base_m: float,
    gain: float,
    range_max_m: float,
    scale_m: float,
) -> NDArray[np.float64]:
    """Return the limit in raw units, before rounding down."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(w > 0, 1.0 / w.astype(np.float64), np.inf)
        cad_m = np.where(w > 0, 1.0 / (1.0 / z + noise_per_m) - base_m, np.inf)
        learned_m = reference_m.astype(np.float64)
        learned_m = learned_m / (1.0 + gain * spread_m / learned_m) - reference_base_m
    limit_m = np.fmin(np.minimum(cad_m, range_max_m), learned_m)
    return np.clip(limit_m / scale_m, 0.0, RAW_MAX)


def static_limit(w: Any, reference_m: Any, spread_m: Any, *figures: float) -> NDArray[np.uint16]:
    out = np.full(np.shape(w), 123, np.uint16)
    static_limit_raw(w, reference_m, spread_m, plain(limits.Margins(*figures)), out)
    return out


def images(rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Inverse depth, learned depth and spread, each absent in a third of the pixels."""
    z, reference_m = rng.uniform(0.2, 8.0, (2, *SHAPE))
    w = np.where(rng.random(SHAPE) < 0.3, 0.0, 1.0 / z)
    reference_m[rng.random(SHAPE) < 0.3] = np.nan
    spread_m = np.where(np.isnan(reference_m), np.nan, rng.uniform(0.0, 0.1, SHAPE))
    return w.astype(np.float32), reference_m.astype(np.float32), spread_m.astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("scale_m", [0.001, 0.0001, 0.01])
def test_static_limit_equals_the_twin(seed: int, scale_m: float) -> None:
    figures = (0.04, 0.011, 0.05, 5.0, 6.0, scale_m)
    arrays = images(np.random.default_rng(seed))
    limit = static_limit(*arrays, *figures).astype(np.float64)
    exact = static_twin(*arrays, *figures)
    assert (limit <= exact + 1e-3).all()
    assert (limit > exact - 1.001).all()
    assert limit.max() <= min(6.0 / scale_m, RAW_MAX)


def test_static_limit_is_the_surface_less_its_margin() -> None:
    """At short range the figures are those of the design: z - (base + noise * z**2), z - (base + gain * spread)."""
    w, z = np.full((1, 2), 1 / 1.5, np.float32), np.full((1, 2), 1.5, np.float32)
    unlearned, spread_m = np.full_like(z, np.nan), np.full_like(z, 0.01)
    cad = static_limit(w, unlearned, unlearned, 0.04, 0.011, 0.05, 5.0, 9.0, 0.001)
    assert int(cad[0, 0]) == pytest.approx(1500 - 40 - 0.011 * 1.5**2 * 1000, abs=2)
    learned = static_limit(0 * w, z, spread_m, 0.04, 0.011, 0.05, 5.0, 9.0, 0.001)
    assert int(learned[0, 0]) == pytest.approx(1500 - 50 - 50, abs=3)


def test_static_limit_without_a_known_surface_is_the_range() -> None:
    w, unlearned = np.zeros((1, 3), np.float32), np.full((1, 3), np.nan, np.float32)
    assert (static_limit(w, unlearned, unlearned, 0.04, 0.01, 0.05, 5.0, 2.5, 0.001) == 2500).all()
    assert (static_limit(w, unlearned, unlearned, 0.04, 0.01, 0.05, 5.0, 60.0, 0.0001) == RAW_MAX).all()


def test_static_limit_of_a_surface_within_its_margin_is_0() -> None:
    w, unlearned = np.full((1, 2), 1 / 0.03, np.float32), np.full((1, 2), np.nan, np.float32)
    assert (static_limit(w, unlearned, unlearned, 0.04, 0.01, 0.05, 5.0, 9.0, 0.001) == 0).all()


@pytest.mark.parametrize("noise_per_m", [0.001, 0.01, 0.05])
def test_a_surface_farther_away_never_has_a_nearer_limit(noise_per_m: float) -> None:
    """Noise grows with depth squared; a wall at 40 m must not hide a person at 2 m."""
    z = np.linspace(0.1, 60.0, 2000, dtype=np.float32)[None]
    unlearned, w = np.full_like(z, np.nan), 1.0 / z
    cad = static_limit(w, unlearned, unlearned, 0.04, 2.0 * noise_per_m, 0.05, 5.0, 60.0, 0.001)
    learned = static_limit(0 * z, z, noise_per_m * z * z, 0.04, 2.0 * noise_per_m, 0.05, 5.0, 60.0, 0.001)
    assert (np.diff(cad.astype(int)) >= 0).all()
    assert (np.diff(learned.astype(int)) >= 0).all()


@pytest.mark.parametrize("radius_px", [0, 1, 4, 15, 80])
@pytest.mark.parametrize("shape", [SHAPE, (1, 9), (9, 1), (1, 1)])
def test_nearest_over_is_the_minimum_filter(radius_px: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(radius_px)
    image = rng.integers(0, RAW_MAX, shape, np.uint16, endpoint=True)
    image[rng.random(shape) < 0.7] = RAW_MAX
    scratch, out = np.empty_like(image), np.empty_like(image)
    nearest_over(image, radius_px, scratch, out)
    assert (out == ndimage.minimum_filter(image, 2 * radius_px + 1, mode="nearest")).all()


def band_twin(
    nearest_w: NDArray[np.float32],
    farthest_w: NDArray[np.float32],
    noise_per_m: float,
    depth_m: float,
    scale_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and upper end in raw units; both RAW_MAX without a robot."""
    front, back = nearest_w > NOTHING_NEAREST, farthest_w > NOTHING_FARTHEST
    drawn = front | back
    near_m = np.where(front, 1.0 / np.where(front, nearest_w, 1.0).astype(np.float64), 0.0)
    far_m = np.maximum(np.where(back, 1.0 / np.where(back, -farthest_w, 1.0).astype(np.float64), 0.0), near_m + depth_m)
    low = np.clip((near_m - noise_per_m * near_m**2) / scale_m, 0, RAW_MAX)
    high = np.clip((far_m + noise_per_m * far_m**2) / scale_m, 0, RAW_MAX)
    return np.where(drawn, low, RAW_MAX), np.where(drawn, high, RAW_MAX)


RECTANGLES = np.array([[2, 20, 5, 40], [10, 30, 30, 60], [36, 36, 0, 60], [37, -1, 61, -1]], np.int32)
"""Two that overlap, one at the edge of the image, an empty one."""


def between(rectangles: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return, for each row, the pixels between the leftmost and the rightmost rectangle."""
    inside = np.zeros(SHAPE, np.bool_)
    for top, bottom, left, right in rectangles:
        inside[top : bottom + 1, left : right + 1] = True
    return np.asarray(np.logical_or.accumulate(inside, 1) & np.logical_or.accumulate(inside[:, ::-1], 1)[:, ::-1])


def windowed(
    image: NDArray[np.float32], rectangles: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return a window of an image (H, W) in the rasterizer's format, and its memory."""
    rows, columns = np.nonzero(between(rectangles))
    if not len(rows):
        return np.zeros(4, np.int64), np.full(image.size, np.nan, np.float32)
    window = np.array((rows.min(), columns.min(), np.ptp(rows) + 1, np.ptp(columns) + 1 + LANES))
    memory = np.full((window[2], window[3]), np.nan, np.float32)
    memory[:, :-LANES] = image[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    return window, np.append(memory.ravel(), np.full(50, np.nan, np.float32))


class Band:
    """The images of `robot_band_raw`."""

    def __init__(self) -> None:
        self.near_raw, self.span_raw = np.full(SHAPE, RAW_MAX, np.uint16), np.zeros(SHAPE, np.uint16)
        self.columns = np.zeros((SHAPE[0], 2), np.int32)
        self.bundle = plain(limits.Band(self.near_raw, self.span_raw, self.columns))

    def draw(self, rng: np.random.Generator, rectangles: NDArray[np.int32], scale_m: float) -> None:
        """Draw random values, and compare all images with the twin's."""
        near_m = rng.uniform(0.05, 8.0, SHAPE)
        inside = between(rectangles)
        drawn = (rng.random(SHAPE) < 0.6) & inside
        # Silhouettes and parts cut by the near plane have only one of the two.
        front, back = drawn & (rng.random(SHAPE) < 0.8), drawn & (rng.random(SHAPE) < 0.8)
        drawn = front | back
        nearest_w = np.where(front, 1.0 / near_m, NOTHING_NEAREST).astype(np.float32)
        far_m = near_m * rng.choice([1.0, 1.3], SHAPE)
        farthest_w = np.where(back, -1.0 / far_m, NOTHING_FARTHEST).astype(np.float32)
        window, nearest = windowed(nearest_w, rectangles)
        _, farthest = windowed(farthest_w, rectangles)
        links = np.ones(len(rectangles), np.bool_)
        buffer = plain(Buffer(window, nearest, farthest))
        robot_band_raw(buffer, rectangles, links, 0.02, 0.15, scale_m, self.bundle)
        low, high = band_twin(nearest_w, farthest_w, 0.02, 0.15, scale_m)
        near, end = self.near_raw.astype(np.float64), self.near_raw.astype(np.float64) + self.span_raw
        slack = 1.0 + 1e-6 * RAW_MAX
        assert np.abs(near - low).max() <= slack
        assert np.abs(end - high).max() <= 1.0 + slack
        assert end.max() <= RAW_MAX
        assert (self.near_raw[~drawn] == RAW_MAX).all()
        assert (self.span_raw[~drawn] == 0).all()
        u = np.arange(SHAPE[1])
        assert (((u >= self.columns[:, :1]) & (u < self.columns[:, 1:])) == inside).all()


@pytest.mark.parametrize("scale_m", [0.001, 0.0001, 0.01])
@pytest.mark.parametrize("seed", range(4))
def test_robot_band_equals_the_twin(seed: int, scale_m: float) -> None:
    """Repeated on the same images: nothing is left of the previous robot."""
    rng = np.random.default_rng(seed)
    band = Band()
    for _ in range(6):
        edges = np.sort(rng.integers(0, SHAPE[0], (3, 2))), np.sort(rng.integers(0, SHAPE[1], (3, 2)))
        band.draw(rng, np.concatenate(edges, axis=1).astype(np.int32), scale_m)
    band.draw(rng, RECTANGLES, scale_m)
    band.draw(rng, RECTANGLES[3:], scale_m)
    assert (band.near_raw == RAW_MAX).all()


def test_a_band_is_cleared_anywhere() -> None:
    band = Band()
    band.draw(np.random.default_rng(0), RECTANGLES, 0.001)
    assert (band.near_raw < RAW_MAX).any()
    clear_band(band.bundle)
    assert (band.near_raw == RAW_MAX).all()
    assert not band.span_raw.any()
    assert not band.columns.any()
    band.draw(np.random.default_rng(0), RECTANGLES[:0], 0.001)


def test_lower_depth_takes_the_nearer() -> None:
    rng = np.random.default_rng(0)
    inside = between(RECTANGLES)
    z_m = np.where(inside & (rng.random(SHAPE) < 0.5), rng.uniform(0.5, 3.0, SHAPE), np.inf)
    before_m = np.where(rng.random(SHAPE) < 0.5, rng.uniform(0.5, 3.0, SHAPE), np.inf).astype(np.float32)
    depth_m = before_m.copy()
    window, nearest = windowed((1.0 / z_m).astype(np.float32), RECTANGLES)
    lower_depth(plain(Buffer(window, nearest, nearest)), RECTANGLES, np.ones(4, np.bool_), depth_m)
    assert np.allclose(depth_m, np.minimum(before_m, z_m))
    lower_depth(plain(Buffer(np.zeros(4, np.int64), nearest, nearest)), RECTANGLES[3:], np.ones(1, np.bool_), depth_m)


def test_robot_band_of_a_surface_at_the_camera_starts_at_0() -> None:
    """No depth is below a band that starts at 0, so no comparison wraps around."""
    w, one = np.full(1, 1 / 0.05, np.float32), np.ones(1, np.bool_)
    near_raw, span_raw = np.zeros((1, 1), np.uint16), np.zeros((1, 1), np.uint16)
    window, rectangles = np.array((0, 0, 1, 1)), np.array([[0, 0, 0, 0]], np.int32)
    columns = np.zeros((1, 2), np.int32)
    band = plain(limits.Band(near_raw, span_raw, columns))
    robot_band_raw(plain(Buffer(window, w, w)), rectangles, one, 50.0, 0.15, 0.001, band)
    assert near_raw[0, 0] == 0
    assert span_raw[0, 0] == pytest.approx(200 + 2000, abs=1)
