# SPDX-License-Identifier: Apache-2.0
"""Bundles are named tuples of arrays and numbers; this module converts them for kernels.

A bundle is defined beside the kernel that owns it.
"""

from __future__ import annotations

from typing import Any, TypeVar, cast

Bundle = TypeVar("Bundle", bound=tuple[Any, ...])


def plain(bundle: Bundle) -> Bundle:
    """Return a bundle as the plain tuple of its values, the form in which Python passes it to a kernel.

    For a named tuple, numba reads the names of class and fields at every call, which costs up to a microsecond a
    bundle; a plain tuple costs almost nothing. A kernel called from Python restores the names: `band = Band(*band)`.
    """
    return cast(Bundle, tuple(bundle))
