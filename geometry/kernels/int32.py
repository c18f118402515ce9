# SPDX-License-Identifier: Apache-2.0
"""Arithmetic in integers of 32 bits. numba widens them to 64, which halves the width of the vector unit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numba import types
from numba.extending import intrinsic


def _add(_: Any, a: Any, b: Any) -> tuple[Any, Callable[..., Any]]:
    def emit(_target: Any, builder: Any, _signature: Any, values: Any) -> Any:
        return builder.add(*values)

    return types.int32(types.int32, types.int32), emit


def _multiply(_: Any, a: Any, b: Any) -> tuple[Any, Callable[..., Any]]:
    def emit(_target: Any, builder: Any, _signature: Any, values: Any) -> Any:
        return builder.mul(*values)

    return types.int32(types.int32, types.int32), emit


def _none_negative(_: Any, a: Any, b: Any, c: Any) -> tuple[Any, Callable[..., Any]]:
    def emit(_target: Any, builder: Any, _signature: Any, values: Any) -> Any:
        signs = builder.or_(builder.or_(values[0], values[1]), values[2])
        return builder.icmp_signed(">=", signs, signs.type(0))

    return types.boolean(types.int32, types.int32, types.int32), emit


add = cast(Callable[[np.int32, np.int32], np.int32], intrinsic(_add))
"""Add two integers modulo 2**32; for kernels."""

multiply = cast(Callable[[np.int32, np.int32], np.int32], intrinsic(_multiply))
"""Multiply two integers modulo 2**32; for kernels."""

none_negative = cast(Callable[[np.int32, np.int32, np.int32], np.bool_], intrinsic(_none_negative))
"""Return True if none of three integers is negative; for kernels."""
