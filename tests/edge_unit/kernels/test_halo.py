# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.kernels.halo import STEP_SHARE, drop_halo, halo_bands, spread_edges

RAW_MAX = 65535
FX, FY = 40.0, 38.0
BASE_M, NOISE_PER_M = 0.03, 0.02
Image = NDArray[np.float32]


def spread(w: Image, padding_m: float) -> tuple[int, Image, Image]:
    nearest, farthest = np.full_like(w, 7), np.full_like(w, 7)
    number = spread_edges(w, padding_m, BASE_M, NOISE_PER_M, FX, FY, nearest, farthest)
    assert number == np.count_nonzero(nearest)
    assert ((nearest > 0) == (farthest > 0)).all()
    return number, nearest, farthest


def spread_twin(w: Image, padding_m: float) -> tuple[Image, Image]:
    """Each edge pixel paints its ellipse over all that lies behind it."""
    nearest, farthest = np.zeros_like(w), np.full_like(w, np.inf)
    v, u = np.mgrid[0 : w.shape[0], 0 : w.shape[1]]
    around = np.pad(w, 1, mode="edge")
    lowest = np.min((around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:]), axis=0)
    for y, x in np.argwhere(w > 0):
        own = w[y, x]
        z = 1.0 / np.float64(own)
        behind = np.float32(1.0 / (z + STEP_SHARE * (BASE_M + NOISE_PER_M * z * z)))
        if not lowest[y, x] < behind:
            continue
        rows, columns = padding_m * FY * own, padding_m * FX * own
        down, across = np.abs(v - y), np.abs(u - x)
        share = np.minimum(down / rows, 1.0) if rows > 0 else np.zeros(w.shape)
        reached = (down <= math.floor(rows)) & (across <= np.floor(columns * np.sqrt(1.0 - share**2))) & (w < behind)
        nearest[reached] = np.maximum(nearest[reached], own)
        farthest[reached] = np.minimum(farthest[reached], own)
    return nearest, np.where(np.isinf(farthest), 0, farthest).astype(np.float32)


def patches(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Surfaces before one another, some of them at the picture's edge, and pixels where nothing is known."""
    w = np.zeros(shape, np.float32)
    for _ in range(6):
        top, left = rng.integers(-5, shape[0]), rng.integers(-5, shape[1])
        patch = w[max(top, 0) : top + rng.integers(1, 20), max(left, 0) : left + rng.integers(1, 20)]
        np.maximum(patch, np.float32(1.0 / rng.uniform(0.3, 4.0)), out=patch)
    return w


@pytest.mark.parametrize("padding_m", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("shape", [(41, 61), (1, 30), (30, 1), (1, 1)])
def test_edges_reach_what_the_twins_reach(padding_m: float, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    for _ in range(4):
        w = patches(rng, shape)
        nearest, farthest = spread_twin(w, padding_m)
        assert (spread(w, padding_m)[1] == nearest).all()
        assert (spread(w, padding_m)[2] == farthest).all()


def test_without_surfaces_and_without_steps_there_is_no_halo() -> None:
    assert spread(np.zeros((9, 11), np.float32), 0.05)[0] == 0
    assert spread(np.full((9, 11), 0.7, np.float32), 0.05)[0] == 0
    # A floor that recedes has no edge, however steep it looks.
    slope = np.linspace(0.9, 0.5, 60, dtype=np.float32)[:, None].repeat(11, axis=1)
    assert spread(slope, 0.05)[0] == 0


def test_an_edge_reaches_its_padding_over_what_lies_behind() -> None:
    w = np.full((41, 61), 0.5, np.float32)
    w[:, :30] = 1.0
    _, nearest, _ = spread(w, 0.1)  # 4 px at 1 m
    assert (nearest[:, 30:34] == 1.0).all()
    assert not nearest[:, 34:].any()
    assert not nearest[:, :30].any(), "what stands before an edge is not touched by it"


@pytest.mark.parametrize("scale_m", [0.001, 0.0001])
def test_bands_are_the_edges_depths_with_their_margins(scale_m: float) -> None:
    rng = np.random.default_rng(0)
    number, nearest, farthest = spread(patches(rng, (41, 61)), 0.2)
    pixels = np.full(number, -1, np.int32)
    near_raw, span_raw = np.zeros(number, np.uint16), np.zeros(number, np.uint16)
    halo_bands(nearest, farthest, BASE_M, NOISE_PER_M, scale_m, pixels, near_raw, span_raw)
    assert (pixels == np.flatnonzero(nearest)).all()
    z_near, z_far = (1.0 / image[nearest > 0].astype(np.float64) for image in (nearest, farthest))
    low = np.clip(np.floor((z_near - BASE_M - NOISE_PER_M * z_near**2) / scale_m), 0, RAW_MAX)
    high = np.clip(np.ceil((z_far + BASE_M + NOISE_PER_M * z_far**2) / scale_m), 0, RAW_MAX)
    assert np.abs(near_raw - low).max() <= 1
    assert np.abs(near_raw.astype(float) + span_raw - high).max() <= 1


@pytest.mark.parametrize("width", [1, 8, 61])
def test_what_lies_in_its_band_is_dropped(width: int) -> None:
    rng = np.random.default_rng(width)
    shape = (23, width)
    edges = np.array([0, 1, 999, 1000, 1001, 65534, 65535], np.uint16)
    depth = rng.choice(edges, shape)
    pixels = np.flatnonzero(rng.random(shape) < 0.5).astype(np.int32)
    near = rng.choice(edges, len(pixels))
    high = np.maximum(near, rng.choice(edges, len(pixels)))
    mask = np.zeros((23, -(-width // 8) * 8), np.uint8)
    mask[:, :width] = rng.random(shape) < 0.8
    wanted = mask.copy()
    for pixel, low, end in zip(pixels.tolist(), near.tolist(), high.tolist(), strict=True):
        y, x = divmod(pixel, width)
        if low <= depth[y, x] <= end:
            wanted[y, x] = 0
    drop_halo(depth, pixels, near, high - near, mask)
    assert (mask == wanted).all()


def test_without_a_halo_nothing_is_dropped() -> None:
    mask = np.ones((3, 8), np.uint8)
    nothing = np.empty(0, np.uint16)
    drop_halo(np.full((3, 5), 1000, np.uint16), np.empty(0, np.int32), nothing, nothing, mask)
    assert mask.all()
