# SPDX-License-Identifier: Apache-2.0
"""The arithmetic of a frame: pure functions on arrays, compiled by numba, all memory handed in.

They import only numpy, numba, math and one another, and take bundles of what belongs together; each has a slow twin in
plain numpy in the tests.
In the order of the flow:

    jit         how kernels are compiled
    bundles     how bundles of arrays and numbers are handed to kernels
    int32       integers of 32 bits that stay so
    pinhole     a point and its place in the picture
    forward     where the links stand, and how far they may be off (Algorithm 5)
    motion      which links have moved since they were drawn
    project     where meshes come to lie on the screen
    rasterize   meshes onto the screen: nearest and farthest inverse depth (Algorithms 2 to 4)
    hull        the surface at a distance from a mesh
    limits      expected depth less margins, as raw depth that a pixel is compared with
    halo        the depths that edges of known surfaces show beside them
    reference   surfaces that the empty cell shows, learned pixel by pixel
    foreground  the pixels that nothing known explains
    voxelize    foreground pixels counted on the lattice (Algorithm 1)
    points      from the image to the counter in one sweep, a few rows at a time
    density     voxels with too few points are noise (Algorithms 6 and 7)
    seen        which blocks of the cell a frame looks through
    agreement   how well measured depth fits expected depth
    align       how far measured points lie from the planes that they should lie on
    misfit      how badly, from where the camera should be and from places close by
"""
