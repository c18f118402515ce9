# SPDX-License-Identifier: Apache-2.0
"""Growth of a mesh by a padding: for each vertex, its motion for one metre of padding.

Links inflated at load time pad silhouette and depth in one rendering, at no cost for each frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared.meshes import TriangleMesh

OFFSET_MAX = 2.0
"""Limit of a vertex's motion in paddings; the tip of a needle would move without bound."""

RIDGE = 1e-3
"""Weight of a regularisation: on a smooth surface it fixes the two directions that the faces leave free."""


def vertex_offsets(mesh: TriangleMesh) -> NDArray[np.float32]:
    """Return offsets (V, 3) such that `vertices + padding * offsets` moves every face outward by about `padding`.

    The mean of the normals would move the faces of a box by only 58 % of the padding. Instead, each vertex solves
    `normal . offset = 1` in the least-squares sense for all faces that meet in it, weighted by their angle there.
    """
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    equations = np.zeros((len(mesh.vertices), 3, 3))
    targets = np.zeros((len(mesh.vertices), 3))
    for k in range(3):
        angle = _corner_angle(corners[:, k], corners[:, (k + 1) % 3], corners[:, (k + 2) % 3])
        np.add.at(equations, mesh.faces[:, k], angle[:, None, None] * normals[:, :, None] * normals[:, None, :])
        np.add.at(targets, mesh.faces[:, k], angle[:, None] * normals)
    weight = np.trace(equations, axis1=1, axis2=2)
    equations += (RIDGE * np.maximum(weight, 1e-12))[:, None, None] * np.eye(3)
    offsets = np.linalg.solve(equations, targets[:, :, None])[:, :, 0]
    length = np.linalg.norm(offsets, axis=1, keepdims=True)
    return np.asarray(offsets * np.minimum(1.0, OFFSET_MAX / np.maximum(length, 1e-12)), dtype=np.float32)


def _corner_angle(at: NDArray[np.float64], one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angles (F,) in rad at the corners `at` (F, 3) between the sides to `one` and to `other`."""
    a, b = one - at, other - at
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ij,ij->i", a, b)))
