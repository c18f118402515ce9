# SPDX-License-Identifier: Apache-2.0
"""How kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a pure function on arrays: without the GIL, kept on disk, division as IEEE 754 has it.

    No `fastmath`: it makes `isnan` false.
    """
    return cast(Function, numba.njit(nogil=True, cache=True, error_model="numpy")(function))
