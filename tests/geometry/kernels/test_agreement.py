# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geometry.kernels.agreement import RESIDUAL_BINS, Tolerance, compare
from geometry.kernels.bundles import plain

BASE_RAW, PER_RAW2 = 40.0, 1e-5


def run(
    depth: NDArray[np.uint16], static: NDArray[np.uint16], robot: NDArray[np.uint16], stride_px: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    bins, tallies = np.full(RESIDUAL_BINS, 7, np.int64), np.full(4, 7, np.int64)
    compare(depth, static, robot, plain(Tolerance(BASE_RAW, PER_RAW2)), stride_px, bins, tallies)
    return bins, tallies


def twin(
    depth: NDArray[np.uint16], static: NDArray[np.uint16], robot: NDArray[np.uint16], stride_px: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    first = stride_px // 2
    d, s, r = (image[first::stride_px, first::stride_px].astype(np.float64) for image in (depth, static, robot))
    measured = d > 0
    compared = measured & (s > 0) & (r == 65535)
    residual = (d - s) / (BASE_RAW + PER_RAW2 * s**2)
    agreeing = compared & (np.abs(residual) <= 1.0)
    middle = RESIDUAL_BINS // 2
    bins = np.bincount(middle + np.rint(residual[agreeing] * middle).astype(int), minlength=RESIDUAL_BINS)
    return bins, np.array([d.size, measured.sum(), compared.sum(), agreeing.sum()])


@pytest.mark.parametrize("stride_px", [1, 3, 8])
@pytest.mark.parametrize("shape", [(43, 61), (1, 1), (5, 200)])
def test_tallies_equal_the_twin(stride_px: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(stride_px)
    static = rng.integers(500, 3000, shape).astype(np.uint16)
    depth = (static + rng.normal(0.0, 60.0, shape)).astype(np.uint16)
    static[rng.random(shape) < 0.2] = 0
    depth[rng.random(shape) < 0.2] = 0
    robot = np.where(rng.random(shape) < 0.2, 900, 65535).astype(np.uint16)
    for found, wanted in zip(run(depth, static, robot, stride_px), twin(depth, static, robot, stride_px), strict=True):
        assert (found == wanted).all()


def test_without_measurements_or_known_surfaces_or_beside_the_robot() -> None:
    shape = (16, 16)
    none, some, far = (np.full(shape, value, np.uint16) for value in (0, 1000, 65535))
    assert run(none, some, far, 1)[1].tolist() == [256, 0, 0, 0]
    assert run(some, none, far, 1)[1].tolist() == [256, 256, 0, 0]
    assert run(some, some, some, 1)[1].tolist() == [256, 256, 0, 0]
    bins, tallies = run(some, some, far, 1)
    assert tallies.tolist() == [256, 256, 256, 256]
    assert bins[RESIDUAL_BINS // 2] == 256


def test_the_ends_of_the_tolerance_have_bins() -> None:
    static, far = np.full((1, 2), 1000, np.uint16), np.full((1, 2), 65535, np.uint16)
    bins, tallies = run(np.array([[950, 1050]], np.uint16), static, far, 1)
    assert tallies[3] == 2
    assert bins[0] == bins[-1] == 1
