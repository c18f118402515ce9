# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from edge_unit.kernels.limits import (
    RAW_MAX,
    clear_band,
    lower_depth,
    nearest_over,
    robot_band_raw,
    span_of_row,
    static_limit_raw,
)
from edge_unit.kernels.rasterize import NOTHING_FARTHEST, NOTHING_NEAREST

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
    """The limit in raw units, not yet rounded down."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(w > 0, 1.0 / w.astype(np.float64), np.inf)
        cad_m = np.where(w > 0, 1.0 / (1.0 / z + noise_per_m) - base_m, np.inf)
        learned_m = reference_m.astype(np.float64)
        learned_m = learned_m / (1.0 + gain * spread_m / learned_m) - reference_base_m
    limit_m = np.fmin(np.minimum(cad_m, range_max_m), learned_m)
    return np.clip(limit_m / scale_m, 0.0, RAW_MAX)


def static_limit(*arguments: object) -> NDArray[np.uint16]:
    out = np.full(np.shape(arguments[0]), 123, np.uint16)
    static_limit_raw(*arguments, out)  # type: ignore[arg-type]
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
def test_static_limit_is_that_of_the_twin(seed: int, scale_m: float) -> None:
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


def test_static_limit_where_nothing_is_known_is_the_range() -> None:
    w, unlearned = np.zeros((1, 3), np.float32), np.full((1, 3), np.nan, np.float32)
    assert (static_limit(w, unlearned, unlearned, 0.04, 0.01, 0.05, 5.0, 2.5, 0.001) == 2500).all()
    assert (static_limit(w, unlearned, unlearned, 0.04, 0.01, 0.05, 5.0, 60.0, 0.0001) == RAW_MAX).all()


def test_static_limit_of_a_surface_within_its_margin_is_0() -> None:
    w, unlearned = np.full((1, 2), 1 / 0.03, np.float32), np.full((1, 2), np.nan, np.float32)
    assert (static_limit(w, unlearned, unlearned, 0.04, 0.01, 0.05, 5.0, 9.0, 0.001) == 0).all()


@pytest.mark.parametrize("noise_per_m", [0.001, 0.01, 0.05])
def test_a_surface_farther_away_never_has_a_nearer_limit(noise_per_m: float) -> None:
    """Noise grows with depth squared; a wall at 40 m must not hide who stands at 2 m."""
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
    """Lower and upper end in raw units; both RAW_MAX where no robot is."""
    drawn = nearest_w > 0.0
    near_m = 1.0 / np.where(drawn, nearest_w, 1.0).astype(np.float64)
    far_m = 1.0 / np.where(drawn, farthest_w, 1.0).astype(np.float64)
    low = np.clip((near_m - noise_per_m * near_m**2) / scale_m, 0, RAW_MAX)
    high = np.clip((far_m + noise_per_m * far_m**2 + depth_m) / scale_m, 0, RAW_MAX)
    return np.where(drawn, low, RAW_MAX), np.where(drawn, high, RAW_MAX)


RECTANGLES = np.array([[2, 20, 5, 40], [10, 30, 30, 60], [36, 36, 0, 60], [37, -1, 61, -1]], np.int32)
"""Two that overlap, one at the picture's edge, an empty one."""


def between(rectangles: NDArray[np.int32]) -> NDArray[np.bool_]:
    """In each row all between the leftmost and the rightmost rectangle."""
    inside = np.zeros(SHAPE, np.bool_)
    for top, bottom, left, right in rectangles:
        inside[top : bottom + 1, left : right + 1] = True
    return np.asarray(np.logical_or.accumulate(inside, 1) & np.logical_or.accumulate(inside[:, ::-1], 1)[:, ::-1])


def test_the_span_of_a_row_holds_all_rectangles() -> None:
    for y, row in enumerate(between(RECTANGLES)):
        first, end = span_of_row(y, RECTANGLES)
        assert np.nonzero(row)[0].tolist() == list(range(first, end))


class Band:
    """The images of `robot_band_raw`, and drawings for it: buffers are wider than the picture."""

    def __init__(self) -> None:
        self.near_raw, self.span_raw = np.full(SHAPE, RAW_MAX, np.uint16), np.zeros(SHAPE, np.uint16)
        self.columns = np.zeros((SHAPE[0], 2), np.int32)
        wide = (SHAPE[0], SHAPE[1] + 5)
        self.kept = np.full(wide, NOTHING_NEAREST), np.full(wide, NOTHING_FARTHEST)

    def draw(self, rng: np.random.Generator, rectangles: NDArray[np.int32], scale_m: float) -> None:
        """Draw what is random, and compare all images with the twin's."""
        near_m = rng.uniform(0.05, 8.0, self.kept[0].shape)
        drawn = rng.random(near_m.shape) < 0.6
        drawn[:, : SHAPE[1]] &= between(rectangles)
        nearest_w = np.where(drawn, 1.0 / near_m, 0.0).astype(np.float32)
        far_m = near_m * rng.choice([1.0, 1.3], near_m.shape)
        farthest_w = np.where(drawn, 1.0 / far_m, NOTHING_FARTHEST).astype(np.float32)
        drawing = nearest_w.copy(), farthest_w.copy()
        robot_band_raw(
            *drawing, *self.kept, rectangles, 0.02, 0.15, scale_m, self.near_raw, self.span_raw, self.columns
        )  # fmt: skip
        inner = np.s_[:, : SHAPE[1]]
        low, high = band_twin(nearest_w[inner], farthest_w[inner], 0.02, 0.15, scale_m)
        near, end = self.near_raw.astype(np.float64), self.near_raw.astype(np.float64) + self.span_raw
        slack = 1.0 + 1e-6 * RAW_MAX
        assert np.abs(near - low).max() <= slack
        assert np.abs(end - high).max() <= 1.0 + slack
        assert end.max() <= RAW_MAX
        empty = ~drawn[inner]
        assert (self.near_raw[empty] == RAW_MAX).all()
        assert (self.span_raw[empty] == 0).all()
        u = np.arange(SHAPE[1])
        assert (((u >= self.columns[:, :1]) & (u < self.columns[:, 1:])) == between(rectangles)).all()
        inside = between(rectangles)
        for got, kept in zip(drawing, self.kept, strict=True):
            assert (got[inner][inside] == kept[inner][inside]).all(), (
                "the drawing is taken in, and what is kept put back"
            )


@pytest.mark.parametrize("scale_m", [0.001, 0.0001, 0.01])
@pytest.mark.parametrize("seed", range(4))
def test_robot_band_is_that_of_the_twin(seed: int, scale_m: float) -> None:
    """Again and again on the same images: of the robot that was there before nothing is left."""
    rng = np.random.default_rng(seed)
    band = Band()
    for kept in band.kept:
        kept[:] = rng.random(kept.shape)
    for _ in range(6):
        edges = np.sort(rng.integers(0, SHAPE[0], (3, 2))), np.sort(rng.integers(0, SHAPE[1], (3, 2)))
        band.draw(rng, np.concatenate(edges, axis=1).astype(np.int32), scale_m)
    band.draw(rng, RECTANGLES, scale_m)
    band.draw(rng, RECTANGLES[3:], scale_m)
    assert (band.near_raw == RAW_MAX).all()


def test_a_band_is_cleared_wherever_it_is() -> None:
    band = Band()
    band.draw(np.random.default_rng(0), RECTANGLES, 0.001)
    assert (band.near_raw < RAW_MAX).any()
    clear_band(band.near_raw, band.span_raw, band.columns)
    assert (band.near_raw == RAW_MAX).all()
    assert not band.span_raw.any()
    assert not band.columns.any()
    band.draw(np.random.default_rng(0), RECTANGLES[:0], 0.001)


def test_lower_depth_takes_the_nearer_and_puts_back_what_is_kept() -> None:
    rng = np.random.default_rng(0)
    wide = (SHAPE[0], SHAPE[1] + 5)
    z_m = np.where(rng.random(wide) < 0.5, rng.uniform(0.5, 3.0, wide), np.inf)
    before_m = np.where(rng.random(SHAPE) < 0.5, rng.uniform(0.5, 3.0, SHAPE), np.inf).astype(np.float32)
    nearest_w, farthest_w = (1.0 / z_m).astype(np.float32), np.ones(wide, np.float32)
    kept = rng.random((2, *wide)).astype(np.float32)
    depth_m = before_m.copy()
    lower_depth(nearest_w, farthest_w, *kept, RECTANGLES, depth_m)
    inside = between(RECTANGLES)
    assert np.allclose(depth_m[inside], np.minimum(before_m, z_m[:, : SHAPE[1]])[inside])
    assert (depth_m[~inside] == before_m[~inside]).all()
    assert (nearest_w[:, : SHAPE[1]][inside] == kept[0][:, : SHAPE[1]][inside]).all()
    assert (farthest_w[:, : SHAPE[1]][inside] == kept[1][:, : SHAPE[1]][inside]).all()


def test_robot_band_of_a_surface_at_the_camera_starts_at_0() -> None:
    """What lies nearer than a band that begins at 0 would wrap around; nothing does."""
    w, kept = np.full((1, 1), 1 / 0.05, np.float32), np.zeros((1, 1), np.float32)
    near_raw, span_raw = np.zeros((1, 1), np.uint16), np.zeros((1, 1), np.uint16)
    rectangles, columns = np.array([[0, 0, 0, 0]], np.int32), np.zeros((1, 2), np.int32)
    robot_band_raw(w, w.copy(), kept, kept, rectangles, 50.0, 0.15, 0.001, near_raw, span_raw, columns)
    assert near_raw[0, 0] == 0
    assert span_raw[0, 0] == pytest.approx(50 + 125 + 150, abs=1)
