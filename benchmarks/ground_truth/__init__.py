# SPDX-License-Identifier: Apache-2.0
"""What `make bench-accuracy` judges, and by which truth.

In the order of the flow:

    things a stage askew to the lattice, a wall on it, and things of known shapes before that
    rules  what is compared: ours, the paper's own rule, a least number of points
    surface what was reported, held against the surface that was there
    trials all of them before the same frames
    curves what came of it as curves, tables and words
    real   the real recordings, frame by frame
    plan   who is compared before what, and how often
"""
