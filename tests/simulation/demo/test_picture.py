# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from shared.lattice import Lattice
from simulation.demo import picture
from simulation.world.world import World


def share_like(image: NDArray[np.uint8], blue: int, green: int, red: int) -> float:
    """Return the share of pixels of about this hue: equal strongest and weakest colours, far apart."""
    wanted = np.array((blue, green, red))
    strong, weak = wanted.argmax(), wanted.argmin()
    difference = image[..., strong].astype(int) - image[..., weak]
    return float(((difference > 60) & (image.argmax(axis=-1) == strong) & (image.argmin(axis=-1) == weak)).mean())


def test_both_halves_show_the_robot_and_the_person(tmp_path: Path) -> None:
    path = tmp_path / "pictures" / "demo.png"
    assert picture.main([str(path)]) == 0
    assert path.stat().st_size <= picture.BYTES_MAX
    image = cv2.imread(str(path))
    assert image is not None
    assert image.shape == (picture.HEIGHT, 2 * picture.WIDTH + picture.GAP_PX, 3)
    for half in (image[:, : picture.WIDTH], image[:, -picture.WIDTH :]):
        assert share_like(half, *picture.COLOURS[picture.Owner.ROBOT]) > 0.004
        assert share_like(half, *picture.COLOURS[picture.Owner.PERSON]) > 0.01


def test_the_map_is_that_of_all_units() -> None:
    lattice, keys, witnesses = picture.merged_map(World.demo(), picture.MOMENT_S)
    assert 300 < len(keys) < lattice.cell_count
    assert (np.diff(keys.astype(np.int64)) > 0).all()
    assert set(witnesses) >= {1, 2, 3}


def test_a_cube_for_each_voxel() -> None:
    lattice = Lattice((1.0, 0.0, -1.0), 0.5, (4, 4, 4))
    keys = lattice.keys(np.array([(0, 0, 0), (3, 2, 1)])).astype(np.uint32)
    mesh = picture.voxel_mesh(lattice, keys)
    assert mesh.vertices[:8].min(axis=0).tolist() == [1.0, 0.0, -1.0]
    assert mesh.vertices[8:].max(axis=0).tolist() == [3.0, 1.5, 0.0]
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    # The sum of the tetrahedra below the faces is positive if the faces point outwards.
    volume = np.linalg.det(corners).sum() / 6.0
    assert volume == pytest.approx(2 * 0.5**3)
