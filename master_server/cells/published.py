# SPDX-License-Identifier: Apache-2.0
"""The cell as units and operators are given it, and what is doubtful about it."""

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
"""A mesh that is longer than so many diagonals of the box: a hall around its smallest cell has half of it, and CAD in
millimetres that is taken for metres has a thousand times its size."""


@dataclass(frozen=True, eq=False)
class PublishedCell:
    """A cell, its document, its meshes' canonical bytes by sha256, and how it is referred to.

    Making one of a large cell takes a while, so it is made outside of the event loop.
    """

    cell: Cell
    document: dict[str, Any]
    meshes: dict[str, bytes]
    reference: CellReference

    @classmethod
    def of(cls, cell: Cell) -> PublishedCell:
        """Publish a cell.

        Raises:
            CellError: one of its meshes is absurdly large and does not even touch the box.
        """
        for doubt in doubts(cell):
            logger.warning("cell %s: %s", cell.name, doubt)
        document, meshes = cell.to_document()
        return cls(cell, document, meshes, CellReference(name=cell.name, sha256=cell.version))

    def with_object_pose(self, name: str, T_world_object: ArrayLike) -> PublishedCell:
        """The same cell with one of its objects elsewhere; quick, for no mesh is touched.

        Raises:
            InputError: no object has this name, or the pose is no rigid transform.
        """
        cell = self.cell.with_object_pose(name, T_world_object)
        return PublishedCell(cell, cell.document(), self.meshes, CellReference(name=cell.name, sha256=cell.version))


def doubts(cell: Cell) -> list[str]:
    """A sentence for each mesh that seems to have another unit than metres.

    Raises:
        CellError: one of those that stand still has nothing in the box at all.
    """
    found = []
    diagonal_m = float(np.linalg.norm(cell.box_max_m - cell.box_min_m))
    for key, mesh, T_world_mesh in _bodies(cell):
        low_m, high_m = mesh.bounds_m
        size_m = float((high_m - low_m).max())
        if size_m <= ABSURD_RATIO * diagonal_m:
            continue
        doubt = (
            f"{key}: its mesh is {size_m:.4g} m long in a box whose diagonal is {diagonal_m:.3g} m; "
            "if its file is in millimetres, set scale: 0.001 beside mesh"
        )
        if T_world_mesh is not None and not _touches(mesh, T_world_mesh, cell.box_min_m, cell.box_max_m):
            raise CellError(f"{doubt} (nothing of it lies in the box)")
        found.append(doubt)
    return found


def _bodies(cell: Cell) -> Iterator[tuple[str, TriangleMesh, Transform | None]]:
    """Name, mesh and pose of all that is known; a robot's links have no one pose."""
    for body in cell.static:
        yield f"static {body.name}", body.mesh, body.T_world_mesh
    for body in cell.objects:
        yield f"object {body.name}", body.mesh, body.T_world_mesh
    for link in cell.robot.links if cell.robot else ():
        yield f"robot link {link.name}", link.mesh, None


def _touches(
    mesh: TriangleMesh, T_world_mesh: Transform, box_min_m: NDArray[np.float64], box_max_m: NDArray[np.float64]
) -> bool:
    """Whether the mesh reaches into the box, or stands around it as a hall does."""
    points_m = apply(T_world_mesh, mesh.vertices)
    return bool(((points_m.min(axis=0) <= box_max_m) & (points_m.max(axis=0) >= box_min_m)).all())
