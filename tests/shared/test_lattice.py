# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from shared.errors import InputError
from shared.lattice import MAX_AXIS, MAX_BLOCKS, MAX_CELLS, Lattice, block_lattice

lattices = st.builds(
    Lattice,
    st.tuples(*[st.floats(-20.0, 20.0)] * 3),
    st.floats(0.01, 0.2),
    st.tuples(*[st.integers(1, 30)] * 3),
)


def points_in(lattice: Lattice, data: st.DataObject) -> NDArray[np.float64]:
    """Draw points (N, 3) in and around the lattice."""
    shares: list[tuple[float, ...]] = data.draw(
        st.lists(st.tuples(*[st.floats(-0.5, 1.5)] * 3), min_size=1, max_size=20)
    )
    return np.array(lattice.origin_m) + np.array(shares) * (np.array(lattice.shape) * lattice.voxel_size_m)


@given(lattices, st.data())
def test_point_lies_in_the_voxel_of_its_index(lattice: Lattice, data: st.DataObject) -> None:
    points = points_in(lattice, data)
    offset = np.abs(points - lattice.centres(lattice.index(points)))
    assert (offset <= lattice.voxel_size_m * (0.5 + 1e-9)).all()


@given(lattices, st.data())
def test_index_is_the_floor_of_python(lattice: Lattice, data: st.DataObject) -> None:
    points = points_in(lattice, data)
    expected = [
        [math.floor((float(p) - o) / lattice.voxel_size_m) for p, o in zip(point, lattice.origin_m, strict=True)]
        for point in points
    ]
    np.testing.assert_array_equal(lattice.index(points), expected)


@given(lattices, st.data())
def test_index_of_a_centre_is_its_index(lattice: Lattice, data: st.DataObject) -> None:
    one_axis = st.integers(-40, 40)
    indices = np.array(data.draw(st.lists(st.tuples(one_axis, one_axis, one_axis), min_size=1, max_size=20)))
    np.testing.assert_array_equal(lattice.index(lattice.centres(indices)), indices)


@given(lattices)
def test_keys_count_all_voxels_once_in_order(lattice: Lattice) -> None:
    indices = np.array(list(itertools.product(*(range(count) for count in lattice.shape))))
    keys = lattice.keys(indices)
    assert keys.dtype == np.dtype("<u4")
    np.testing.assert_array_equal(keys, np.arange(lattice.cell_count))
    back = lattice.indices(keys)
    assert back.dtype == np.int16
    np.testing.assert_array_equal(back, indices)


@given(st.floats(-20.0, 20.0), st.integers(1, 400), st.sampled_from([0.01, 0.02, 0.03, 0.05, 0.07, 0.1]))
def test_covering_has_the_exact_count_of_voxels(low: float, count: int, size: float) -> None:
    # A box of a whole number of voxels, as people write it, in decimal.
    high = round(low, 2) + round(count * size, 2)
    lattice = Lattice.covering((round(low, 2), 0.0, 0.0), (high, size, size), size)
    assert lattice.shape == (count, 1, 1)


@given(st.floats(-20.0, 20.0), st.floats(0.001, 10.0), st.floats(0.02, 0.1))
def test_covering_contains_every_point_of_the_box(low: float, length: float, size: float) -> None:
    high = low + length
    assume(high > low)
    lattice = Lattice.covering((low, low, low), (high, high, high), size)
    inside = np.array([[low] * 3, [(low + high) / 2.0] * 3, [high - 2e-6 * size - 1e-9] * 3])
    assert lattice.contains(lattice.index(np.maximum(inside, low))).all()
    assert (lattice.shape[0] - 1) * size < length + 1e-9


def test_borders_belong_to_the_voxel_above_also_below_zero() -> None:
    lattice = Lattice((-0.5, -0.5, -0.5), 0.25, (4, 4, 4))
    steps = np.array([-0.75, -0.5, -0.25, 0.0, 0.25, 0.5])
    points = np.column_stack((steps, steps, steps))
    np.testing.assert_array_equal(lattice.index(points)[:, 0], [-1, 0, 1, 2, 3, 4])
    np.testing.assert_array_equal(lattice.contains(lattice.index(points)), [False, True, True, True, True, False])
    # Just below a border, on either side of zero: truncation would put both into the same voxel.
    np.testing.assert_array_equal(lattice.index(np.array([-1e-9, -1e-9, 1e-9])), [1, 1, 2])


def test_origin_off_the_grid_does_not_shift_anything() -> None:
    # The paper's Algorithm 1 adds half a length to a number of voxels; at 5 cm one point in forty is then misplaced.
    lattice = Lattice((0.0, 0.0, 0.0), 0.05, (10, 10, 10))
    np.testing.assert_array_equal(lattice.index(np.array([0.049, 0.0, 0.499])), [0, 0, 9])


def test_arrays_of_points_keep_their_shape() -> None:
    lattice = Lattice((0, 0, 0), 0.1, (4, 4, 4))
    points = np.zeros((2, 5, 3), dtype=np.float32)
    assert lattice.index(points).shape == (2, 5, 3)
    assert lattice.contains(lattice.index(points)).shape == (2, 5)
    assert lattice.centres(np.zeros((0, 3), dtype=np.int16)).shape == (0, 3)
    assert lattice.keys(np.zeros((0, 3), dtype=np.int16)).shape == (0,)


def test_indices_outside_have_no_key() -> None:
    lattice = Lattice((0, 0, 0), 0.1, (2, 3, 4))
    for index in ([2, 0, 0], [0, 3, 0], [0, 0, 4], [-1, 0, 0]):
        with pytest.raises(InputError, match=r"expected 0 <= index < \(2, 3, 4\)"):
            lattice.keys(np.array([index]))
    for key in (24, -1, 2**32):
        with pytest.raises(InputError, match="keys: expected 0 <= key < 24"):
            lattice.indices(np.array([key]))


def test_largest_lattice_is_accepted_and_larger_refused() -> None:
    assert Lattice((0, 0, 0), 0.01, (512, 512, 512)).cell_count == MAX_CELLS
    key = Lattice((0, 0, 0), 0.01, (512, 512, 512)).keys(np.array([[511, 511, 511]]))
    assert key[0] == MAX_CELLS - 1
    with pytest.raises(InputError, match="expected at most 134217728, choose larger voxels or a smaller box"):
        Lattice((0, 0, 0), 0.01, (512, 512, 513))
    with pytest.raises(InputError, match="expected three counts of 1 to 32767"):
        Lattice((0, 0, 0), 0.01, (MAX_AXIS + 1, 1, 1))


@pytest.mark.parametrize(
    ("origin", "size", "shape", "words"),
    [
        ((0, 0), 0.1, (1, 1, 1), "lattice origin_m"),
        ((0, 0, math.nan), 0.1, (1, 1, 1), "lattice origin_m"),
        ((0, 0, 0), 0.0, (1, 1, 1), "lattice voxel_size_m"),
        ((0, 0, 0), math.inf, (1, 1, 1), "lattice voxel_size_m"),
        ((0, 0, 0), 0.1, (1, 0, 1), "lattice shape"),
        ((0, 0, 0), 0.1, (1, 1), "lattice shape"),
    ],
)
def test_impossible_lattices_are_refused(
    origin: tuple[float, float, float], size: float, shape: tuple[int, int, int], words: str
) -> None:
    with pytest.raises(InputError, match=f"^{words}: expected"):
        Lattice(origin, size, shape)


@pytest.mark.parametrize(
    ("low", "high", "size"),
    [
        ((0, 0, 0), (1, 1, 0), 0.1),
        ((0, 0, 0), (1, 1, -1), 0.1),
        ((0, 0, 0), (1, 1, math.nan), 0.1),
        ((0, 0, 0), (math.inf, 1, 1), 0.1),
        ((0, 0), (1, 1), 0.1),
        ((0, 0, 0), (1, 1, 1), 0.0),
        ((0, 0, 0), (1, 1, 1), math.nan),
        ((0, 0, 0), (1, 1, 1), 1e-300),
    ],
)
def test_impossible_boxes_are_refused(low: tuple[float, ...], high: tuple[float, ...], size: float) -> None:
    with pytest.raises(InputError):
        Lattice.covering(low, high, size)


@pytest.mark.parametrize(
    ("origin", "size", "shape", "message"),
    [
        ("abc", 0.1, (1, 1, 1), "lattice origin_m: expected three finite numbers, got 'abc'"),
        (None, 0.1, (1, 1, 1), "lattice origin_m: expected three finite numbers, got None"),
        ((0, (1, 2), 0), 0.1, (1, 1, 1), "lattice origin_m: expected three finite numbers, got (0, (1, 2), 0)"),
        ((0, 0, 0), "x", (1, 1, 1), "lattice voxel_size_m: expected a positive length, got 'x'"),
        ((0, 0, 0), None, (1, 1, 1), "lattice voxel_size_m: expected a positive length, got None"),
        ((0, 0, 0), 0.1, None, "lattice shape: expected three counts of 1 to 32767, got None"),
        ((0, 0, 0), 0.1, ("a", 1, 1), "lattice shape: expected three counts of 1 to 32767, got ('a', 1, 1)"),
        ((0, 0, 0), 0.1, (math.nan, 1, 1), "lattice shape: expected three counts of 1 to 32767, got (nan, 1, 1)"),
        ((0, 0, 0), 0.1, (1.9, 1, 1), "lattice shape: expected three counts of 1 to 32767, got (1.9, 1, 1)"),
        ((0, 0, 0), 0.1, (), "lattice shape: expected three counts of 1 to 32767, got ()"),
    ],
)
def test_invalid_lattices_raise_one_clear_error(origin: Any, size: Any, shape: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        Lattice(origin, size, shape)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("low", "high", "size", "message"),
    [
        ("a", (1, 1, 1), 0.1, "box_min_m: expected three finite numbers, got 'a'"),
        ((0, 0, 0), None, 0.1, "box_max_m: expected three finite numbers, got None"),
        ((0, 0, 0), (1, 1, 1), None, "voxel_size_m: expected a positive length, got None"),
        ((0, 0, 0), (1, 1, 1), "x", "voxel_size_m: expected a positive length, got 'x'"),
    ],
)
def test_invalid_boxes_raise_one_clear_error(low: Any, high: Any, size: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        Lattice.covering(low, high, size)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("call", "value", "message"),
    [
        ("index", np.zeros((4, 2)), "points_m: expected three values on the last axis, got shape (4, 2)"),
        ("index", 0.5, "points_m: expected three values on the last axis, got shape ()"),
        ("index", [0.0, math.nan, 0.0], "points_m: expected finite numbers"),
        ("index", [0.0, math.inf, 0.0], "points_m: expected finite numbers"),
        ("index", [0.0, 1.7e308, 0.0], "points_m: expected finite numbers"),
        ("index", None, "points_m: expected numbers, got None"),
        ("contains", [[0, 0]], "indices: expected three values on the last axis, got shape (1, 2)"),
        ("centres", ["a"], "indices: expected numbers, got ['a']"),
        ("keys", [0, 0, 0], "indices: expected shape (N, 3), got (3,)"),
        ("keys", np.zeros((3, 2), np.int16), "indices: expected three values on the last axis, got shape (3, 2)"),
        ("keys", [[0.9, 0, 0]], "indices: expected integers, got [[0.9, 0, 0]]"),
        ("keys", [[True, False, True]], "indices: expected integers"),
        ("indices", ["a"], "keys: expected integers, got ['a']"),
        ("indices", [1.9], "keys: expected integers, got [1.9]"),
        ("indices", [[1], [2, 3]], "keys: expected integers, got [[1], [2, 3]]"),
    ],
)
def test_invalid_points_raise_one_clear_error(call: str, value: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        getattr(Lattice((0, 0, 0), 0.1, (2, 3, 4)), call)(value)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_equal_lattices_are_equal() -> None:
    one = Lattice.covering((-1.5, -1.5, -0.2), (1.5, 1.5, 1.8), 0.1)
    assert one.shape == (30, 30, 20)
    assert one == Lattice((np.float64(-1.5), -1.5, -0.2), 0.1, (30, 30, 20))
    assert len({one, Lattice(one.origin_m, one.voxel_size_m, one.shape)}) == 1


@given(
    st.tuples(*[st.integers(1, 500)] * 3).filter(lambda shape: np.prod(shape) <= MAX_CELLS),
    st.data(),
)
def test_keys_and_indices_are_inverse_and_in_the_same_order(shape: tuple[int, int, int], data: st.DataObject) -> None:
    lattice = Lattice((0.0, 0.0, 0.0), 0.1, shape)
    _, ny, nz = shape
    triples = data.draw(st.lists(st.tuples(*[st.integers(0, count - 1) for count in shape]), max_size=20))
    indices = np.array(triples, np.int16).reshape(-1, 3)
    keys = lattice.keys(indices)
    assert keys.dtype == np.dtype("<u4")
    assert keys.tolist() == [(ix * ny + iy) * nz + iz for ix, iy, iz in triples]
    assert np.array_equal(lattice.indices(keys), indices)
    by_key = sorted(range(len(triples)), key=keys.tolist().__getitem__)
    assert [triples[number] for number in by_key] == sorted(triples)
    for outside in (lattice.cell_count, 2**32 - 1):
        with pytest.raises(InputError, match="key"):
            lattice.indices(np.array([*keys.tolist(), outside], np.uint32))


def test_a_hall_has_larger_blocks() -> None:
    low, high = np.zeros(3), np.array([100.0, 100.0, 10.0])
    blocks = block_lattice(low, high, 0.05)
    assert blocks.cell_count <= MAX_BLOCKS < 8 * blocks.cell_count
    assert blocks.voxel_size_m == 0.05 * 2**5
    assert block_lattice(low, np.ones(3), 0.1) == Lattice.covering(low, np.ones(3), 0.1)
