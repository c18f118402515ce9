# SPDX-License-Identifier: Apache-2.0
"""How bundles, named tuples of arrays and numbers, are handed to kernels.

A bundle is defined beside the kernel that owns it.
"""

from __future__ import annotations

from typing import Any, TypeVar, cast

Bundle = TypeVar("Bundle", bound=tuple[Any, ...])


def plain(bundle: Bundle) -> Bundle:
    """A bundle as the plain tuple of its values, which is how a kernel takes it from Python.

    Of a named tuple numba reads the names of class and fields at every call, which costs up to a microsecond a bundle;
    of a plain one, next to nothing. A kernel that Python calls names its bundles again: `band = Band(*band)`.
    """
    return cast(Bundle, tuple(bundle))
