# SPDX-License-Identifier: Apache-2.0
"""Ground truth of `make bench-accuracy`: the scenes, the rules that are compared, and the judges.

In the order of the flow:

    things   a stage askew to the lattice, a wall on it, and things of known shapes in front of the wall
    rules    the compared filters: ours, the paper's own rule, a minimum number of points
    surface  compares the reported voxels with the true surface
    trials   runs all contenders on the same frames
    curves   turns the tallies into curves, tables and remarks
    real     the real recordings, frame by frame
    plan     lists the contenders, scenes and numbers of frames
"""
