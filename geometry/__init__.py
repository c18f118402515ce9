# SPDX-License-Identifier: Apache-2.0
"""Drawing and the arithmetic of a frame, for whoever needs them; it imports only `shared`.

The folder of compiled kernels is settled here, before the first kernel is imported, so this page re-exports nothing.
In the order of the flow:

    compilation/  where compiled kernels are kept and found
    kernels/      pure functions on arrays, compiled by numba
    rendering/    meshes, links and padded hulls, drawn as a camera sees them
"""

from geometry.compilation.cache import settle

settle()
