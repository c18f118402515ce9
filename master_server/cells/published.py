# SPDX-License-Identifier: Apache-2.0
"""The cell as units and operators receive it, with warnings about doubtful meshes."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.cell import Cell
from shared.errors import CellError
from shared.meshes import TriangleMesh
from shared.messages import CellReference
from shared.transforms import Transform, apply

logger = logging.getLogger(__name__)

ABSURD_RATIO = 10.0
"""Largest mesh, in diagonals of the box. A hall around the smallest cell has half of it. CAD in millimetres that is
read as metres has a thousand times its true size."""


@dataclass(frozen=True, eq=False)
class PublishedCell:
    """A cell, its document, the canonical bytes of its meshes by sha256, and its reference (name and hash).

    Publishing a large cell takes long, so it happens outside of the event loop.
    """

    cell: Cell
    document: dict[str, Any]
    meshes: dict[str, bytes]
    reference: CellReference

    @classmethod
    def of(cls, cell: Cell) -> PublishedCell:
        """Publish a cell.

        Raises:
            CellError: a mesh is far too large and does not touch the box.
        """
        for doubt in doubts(cell):
            logger.warning("cell %s: %s", cell.name, doubt)
        document, meshes = cell.to_document()
        return cls(cell, document, meshes, CellReference(name=cell.name, sha256=cell.version))

    def with_object_pose(self, name: str, T_world_object: ArrayLike) -> PublishedCell:
        """Return the same cell with another pose of one object. This is fast, since no mesh changes.

        Raises:
            InputError: no object has this name, or the pose is not a rigid transform.
        """
        cell = self.cell.with_object_pose(name, T_world_object)
        return PublishedCell(cell, cell.document(), self.meshes, CellReference(name=cell.name, sha256=cell.version))


def doubts(cell: Cell) -> list[str]:
    """Return a sentence for each mesh whose file seems not to be in metres.

    Raises:
        CellError: such a mesh belongs to a fixed body and lies completely outside of the box.
    """
    found = []
    diagonal_m = float(np.linalg.norm(cell.box_max_m - cell.box_min_m))
    for key, mesh, T_world_mesh in _bodies(cell):
        low_m, high_m = mesh.bounds_m
        size_m = float((high_m - low_m).max())
        if size_m <= ABSURD_RATIO * diagonal_m:
            continue
        doubt = (
            f"{key}: its mesh is {size_m:.4g} m long, but the diagonal of the box is {diagonal_m:.3g} m; "
            "if its file is in millimetres, set scale: 0.001 beside mesh"
        )
        if T_world_mesh is not None and not _touches(mesh, T_world_mesh, cell.box_min_m, cell.box_max_m):
            raise CellError(f"{doubt} (nothing of it lies in the box)")
        found.append(doubt)
    return found


def _bodies(cell: Cell) -> Iterator[tuple[str, TriangleMesh, Transform | None]]:
    """Yield name, mesh and pose of every known body; the pose of a robot's link is None, since it changes."""
    for body in cell.static:
        yield f"static {body.name}", body.mesh, body.T_world_mesh
    for body in cell.objects:
        yield f"object {body.name}", body.mesh, body.T_world_mesh
    for link in cell.robot.links if cell.robot else ():
        yield f"robot link {link.name}", link.mesh, None


def _touches(
    mesh: TriangleMesh, T_world_mesh: Transform, box_min_m: NDArray[np.float64], box_max_m: NDArray[np.float64]
) -> bool:
    """Return True if the mesh reaches into the box or surrounds it, as a hall does."""
    points_m = apply(T_world_mesh, mesh.vertices)
    return bool(((points_m.min(axis=0) <= box_max_m) & (points_m.max(axis=0) >= box_min_m)).all())
