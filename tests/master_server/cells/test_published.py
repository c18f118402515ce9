# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import logging

import numpy as np
import pytest

from master_server.cells.published import PublishedCell
from shared.cell import Cell, PlacedMesh
from shared.errors import CellError, InputError
from shared.meshes import box_mesh
from shared.transforms import from_xyz_rpy


def cell_with(size: float, x: float, as_object: bool = False) -> Cell:
    """A box of a metre, and a slab a tenth as thick as it is wide."""
    slab = PlacedMesh("slab", box_mesh("slab", (size, size, 0.1 * size)), from_xyz_rpy((x, 0.0, 0.0), (0.0, 0.0, 0.0)))
    static, objects = ((), (slab,)) if as_object else ((slab,), ())
    return Cell("test", np.zeros(3), np.ones(3), static, objects)


def test_the_published_cell_equals_the_cell() -> None:
    cell = cell_with(0.5, 0.5, as_object=True)
    published = PublishedCell.of(cell)
    assert (published.document, published.meshes) == cell.to_document()
    assert published.reference.sha256 == cell.version


def test_a_moved_object_changes_no_mesh() -> None:
    cell = cell_with(0.5, 0.5, as_object=True)
    pose = from_xyz_rpy((0.2, 0.3, 0.4), (0.0, 0.0, 1.0))
    before = PublishedCell.of(cell)
    after = before.with_object_pose("slab", pose)
    assert after.meshes is before.meshes
    assert after.document == cell.with_object_pose("slab", pose).document()
    assert after.reference != before.reference
    assert Cell.from_document(after.document, after.meshes).version == after.reference.sha256
    with pytest.raises(InputError, match="expected one of slab, got slap"):
        before.with_object_pose("slap", pose)


@pytest.mark.parametrize("as_object", [False, True])
def test_cad_in_millimetres_is_reported(as_object: bool, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        PublishedCell.of(cell_with(8.0, 0.5, as_object))
    assert not caplog.records
    # It reaches into the box, so it may be intended; the log has a warning.
    with caplog.at_level(logging.WARNING):
        PublishedCell.of(cell_with(500.0, 0.5, as_object))
    assert "its mesh is 500 m long, but the diagonal of the box is 1.73 m" in caplog.text
    assert "set scale: 0.001" in caplog.text
    with pytest.raises(CellError, match=r"slab: .* set scale: 0.001 .*nothing of it lies in the box"):
        PublishedCell.of(cell_with(500.0, 700.0, as_object))


def test_a_mesh_beside_the_box_is_valid() -> None:
    assert PublishedCell.of(cell_with(0.5, 5.0)).meshes
