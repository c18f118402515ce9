# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.int32 import add, multiply, none_negative
from geometry.kernels.jit import kernel


@kernel
def each(
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    c: NDArray[np.int32],
    sums: NDArray[np.int32],
    products: NDArray[np.int32],
    signs: NDArray[np.bool_],
) -> None:
    for i in range(len(a)):
        sums[i] = add(a[i], b[i])
        products[i] = multiply(a[i], b[i])
        signs[i] = none_negative(a[i], b[i], c[i])


def test_results_equal_numpy_also_on_overflow() -> None:
    rng = np.random.default_rng(0)
    limits = np.iinfo(np.int32)
    edges = np.array((limits.min, -1, 0, 1, limits.max), np.int32)
    a, b, c = rng.integers(limits.min, limits.max, (3, 2000), np.int32, endpoint=True)
    grid = np.stack(np.meshgrid(edges, edges, edges), axis=-1).reshape(-1, 3).T
    a, b, c = (np.ascontiguousarray(np.append(one, other)) for one, other in zip((a, b, c), grid, strict=True))
    sums, products, signs = np.empty_like(a), np.empty_like(a), np.empty(len(a), np.bool_)
    each(a, b, c, sums, products, signs)
    assert (sums == a + b).all()
    assert (products == a * b).all()
    assert (signs == ((a >= 0) & (b >= 0) & (c >= 0))).all()
