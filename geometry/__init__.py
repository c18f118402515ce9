# SPDX-License-Identifier: Apache-2.0
"""Kernels and rendering for every package that needs them. It imports only `shared`.

Importing this package chooses the folder of compiled kernels, before the first kernel is imported. So it re-exports
nothing.
In the order of the flow:

    compilation/  the folder of compiled kernels
    kernels/      pure functions on arrays, compiled by numba
    rendering/    depth images of meshes, links and padded hulls
"""

from geometry.compilation.cache import settle

settle()
