# SPDX-License-Identifier: Apache-2.0
"""Kernels: pure functions on arrays, compiled by numba, in memory of the caller.

They import only numpy, numba, math and one another. Related arguments are bundled. Each kernel has a slow twin in plain
numpy in the tests.
In the order of the flow:

    jit         compiler options of kernels
    bundles     conversion of bundles of arrays and numbers for kernels
    int32       arithmetic in integers of 32 bits
    pinhole     projection of points into the image
    forward     poses of the links, and bounds of their errors (Algorithm 5)
    motion      links that moved since they were drawn
    project     projection of meshes onto the screen
    rasterize   nearest and farthest inverse depth of meshes (Algorithms 2 to 4)
    hull        the surface at a distance from a mesh
    limits      expected depth less margins, as raw depth for the comparison with pixels
    halo        depths that edges of known surfaces cause beside them
    reference   background model of each pixel, learned from the empty cell
    foreground  mask of the pixels that no known surface explains
    voxelize    foreground pixels counted on the lattice (Algorithm 1)
    points      image to counter in one sweep, a few rows at a time
    density     removal of voxels with too few points (Algorithms 6 and 7)
    seen        blocks of the cell that a frame looks through
    agreement   agreement of measured with expected depth
    align       distances of measured points from the expected planes
    misfit      robust misfit of a frame for a camera at another pose
"""
