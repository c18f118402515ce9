# SPDX-License-Identifier: Apache-2.0
"""Compiler options of kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a pure function on arrays: without the GIL, cached on disk, with division as in IEEE 754.

    Not with `fastmath`, which makes `isnan` return False.
    """
    return cast(Function, numba.njit(nogil=True, cache=True, error_model="numpy")(function))
