# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geometry.kernels.bundles import plain
from geometry.kernels.halo import Halo, Margin, drop_halo, halo_bands, spread_edges
from geometry.kernels.pinhole import Camera

SHAPE = (31, 47)
FX, FY = 60.0, 70.0
BASE_M, NOISE_PER_M, SCALE_M = 0.03, 0.02, 0.001
RAW_MAX = 65535
MARGIN, CAMERA = plain(Margin(BASE_M, NOISE_PER_M)), plain(Camera(FX, FY, 23.0, 15.0, SHAPE[1], SHAPE[0]))


def bands(w: NDArray[np.float32], padding_m: float) -> tuple[NDArray[np.int32], NDArray[np.uint16], NDArray[np.uint16]]:
    nearest_w, farthest_w = np.full((2, *w.shape), 7.0, np.float32)
    number = spread_edges(w, padding_m, MARGIN, CAMERA, nearest_w, farthest_w)
    assert number == np.count_nonzero(nearest_w)
    pixels = np.empty(number, np.int32)
    near_raw, span_raw = np.empty((2, number), np.uint16)
    halo_bands(nearest_w, farthest_w, MARGIN, SCALE_M, pixels, near_raw, span_raw)
    return pixels, near_raw, span_raw


def twin(w: NDArray[np.float32], padding_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the depths of the nearest and the farthest edge that reaches each pixel, NaN for none."""
    height, width = w.shape
    with np.errstate(divide="ignore"):
        z = np.where(w > 0, 1.0 / w.astype(np.float64), np.inf)
    nearest, farthest = np.full((2, height, width), np.nan)
    v, u = np.mgrid[0:height, 0:width]
    bordered = np.pad(z, 1, mode="edge")
    around = np.stack((bordered[1:-1, :-2], bordered[1:-1, 2:], bordered[:-2, 1:-1], bordered[2:, 1:-1])).max(axis=0)
    for row, column in np.argwhere(np.isfinite(z)):
        depth = z[row, column]
        behind = depth + 0.5 * (BASE_M + NOISE_PER_M * depth**2)
        if not around[row, column] > behind:
            continue
        offset_m = np.hypot((u - column) / FX, (v - row) / FY) * depth
        reached = (offset_m <= padding_m) & (z > behind)
        nearest[reached] = np.fmin(nearest[reached], depth)
        farthest[reached] = np.fmax(farthest[reached], depth)
    return nearest, farthest


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("padding_m", [0.0, 0.0513, 0.21])
def test_finds_the_same_bands_as_the_twin(seed: int, padding_m: float) -> None:
    rng = np.random.default_rng(seed)
    z = np.full(SHAPE, np.inf)
    for _ in range(6):
        row, column = rng.integers(0, SHAPE[0]), rng.integers(0, SHAPE[1])
        patch = z[row : row + rng.integers(1, 15), column : column + rng.integers(1, 20)]
        np.minimum(patch, rng.uniform(0.4, 3.0), out=patch)
    w = (1.0 / z).astype(np.float32)
    nearest, farthest = twin(w, padding_m)
    pixels, near_raw, span_raw = bands(w, padding_m)
    assert np.array_equal(pixels, np.flatnonzero(np.isfinite(nearest)))
    low = nearest.ravel()[pixels]
    low_m = low * low / (low + NOISE_PER_M * low**2) - BASE_M
    high = farthest.ravel()[pixels]
    high_m = high + BASE_M + NOISE_PER_M * high**2
    np.testing.assert_allclose(near_raw * SCALE_M, low_m, atol=0.0011)
    np.testing.assert_allclose((near_raw.astype(float) + span_raw) * SCALE_M, high_m, atol=0.0011)
    assert padding_m == 0.0 or len(pixels) > 10


def edge(near_m: float, far_m: float) -> NDArray[np.float32]:
    w = np.full(SHAPE, 1.0 / far_m if np.isfinite(far_m) else 0.0, np.float32)
    w[:, :20] = 1.0 / near_m
    return w


@pytest.mark.parametrize("far_m", [2.0, np.inf])
def test_an_edge_reaches_its_padding_and_no_farther(far_m: float) -> None:
    pixels, _, _ = bands(edge(1.0, far_m), 0.1)
    assert sorted(set((pixels % SHAPE[1]).tolist())) == list(range(20, 26))  # 0.1 m at 1 m and 60 px: 6 px
    assert len(pixels) == 6 * SHAPE[0]


def test_a_small_step_is_no_edge() -> None:
    assert len(bands(edge(1.0, 1.02), 0.1)[0]) == 0
    assert len(bands(edge(1.0, 1.03), 0.1)[0]) > 0


def test_a_plane_at_a_slant_has_no_edge() -> None:
    w = np.broadcast_to(np.linspace(0.5, 0.6, SHAPE[1], dtype=np.float32), SHAPE).copy()
    assert len(bands(w, 0.1)[0]) == 0


def test_an_edge_that_fills_the_image_and_one_beyond_raw_depth() -> None:
    pixels, near_raw, span_raw = bands(edge(0.051, 1.0), 5.0)
    assert len(pixels) == SHAPE[0] * (SHAPE[1] - 20)
    assert (near_raw == 20).all()
    _, near_raw, span_raw = bands(edge(64.0, 90.0), 30.0)
    assert (near_raw.astype(int) + span_raw == RAW_MAX).all()


def test_only_pixels_in_the_band_are_dropped() -> None:
    depth = np.array([[0, 900, 950, 1000, 1050, 1051, RAW_MAX, 1000]], np.uint16)
    mask = np.ones((1, 16), np.uint8)
    mask[0, 7] = 0
    for top in (0, 40):
        runs = np.array([[top, 0, 0, 3], [top, 3, 3, 7]], np.int32)
        found = mask.copy()
        drop_halo(depth, top, plain(Halo(runs, np.full(7, 950, np.uint16), np.full(7, 100, np.uint16))), found)
        assert found[0].tolist() == [1, 1, 0, 0, 0, 1, 1, 0] + [1] * 8
