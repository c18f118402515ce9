# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import zlib

import numpy as np
import pytest
from numpy.typing import NDArray

from master_server.core.coverage import Coverage
from shared.errors import WireError
from shared.lattice import Lattice
from shared.messages import SeenReport, matrix_of
from shared.transforms import look_at
from shared.wire import pack_seen

BLOCKS = Lattice((0.0, 0.0, 0.0), 0.1, (5, 4, 3))


def report(grid: NDArray[np.bool_], block_size_m: float = 0.1) -> SeenReport:
    packed = pack_seen(grid, block_size_m)
    assert packed is not None
    return packed


def noise(seed: int, shape: tuple[int, int, int] = BLOCKS.shape) -> NDArray[np.bool_]:
    return np.random.default_rng(seed).random(shape) < 0.5


def test_what_units_see_is_counted() -> None:
    coverage = Coverage(BLOCKS)
    coverage.report(1, report(noise(1)))
    coverage.report(2, report(noise(2)))
    coverage.report(3, report(noise(3)))
    expected = noise(1).astype(np.uint8) + noise(3)
    assert np.array_equal(coverage.seen_by([1, 3, 99]), expected)


def test_without_units_all_is_unseen() -> None:
    coverage = Coverage(BLOCKS)
    coverage.report(1, report(noise(1)))
    assert not coverage.seen_by([]).any()
    coverage.withdraw(1)
    coverage.withdraw(1)
    assert not coverage.has(1)
    assert not coverage.seen_by([1]).any()


def test_range_is_measured_along_the_camera_axis() -> None:
    coverage = Coverage(BLOCKS)
    from_below, sideways = np.eye(4), look_at(np.array([-1.0, 0.2, 0.15]), np.array([0.0, 0.2, 0.15]))
    assert coverage.range_m(1, matrix_of(from_below)) is None
    seen = np.zeros(BLOCKS.shape, bool)
    coverage.report(1, report(seen))
    assert coverage.range_m(1, matrix_of(from_below)) is None
    seen[0, 3, 0] = seen[3, 1, 1] = True
    coverage.report(1, report(seen))
    assert coverage.range_m(1, matrix_of(from_below)) == pytest.approx(0.15)
    assert coverage.range_m(1, matrix_of(sideways)) == pytest.approx(1.35)


def test_a_larger_block_covers_all_blocks_inside_it() -> None:
    coverage = Coverage(BLOCKS)
    coarse = np.zeros((3, 2, 2), bool)
    coarse[2, 1, 0] = True
    coverage.report(1, report(coarse, 0.2))
    assert np.argwhere(coverage.seen_by([1])).tolist() == [[4, 2, 0], [4, 2, 1], [4, 3, 0], [4, 3, 1]]


def test_blocks_that_a_report_does_not_reach_are_unseen() -> None:
    coverage = Coverage(BLOCKS)
    coverage.report(1, report(np.ones((2, 2, 2), bool)))
    assert coverage.seen_by([1]).sum() == 8


def test_a_huge_block_takes_no_more_memory_than_the_cell() -> None:
    coverage = Coverage(BLOCKS)
    bits = zlib.compress(b"\xff")
    coverage.report(1, SeenReport(block_size_m=1000.0, shape=(2, 2, 2), bits=bits))
    assert coverage.seen_by([1]).all()


@pytest.mark.parametrize("size_m", [0.05, 0.15, 0.1001])
def test_other_blocks_are_refused(size_m: float) -> None:
    coverage = Coverage(BLOCKS)
    with pytest.raises(WireError, match="block_size_m"):
        coverage.report(1, report(noise(1), size_m))
    assert not coverage.has(1)
