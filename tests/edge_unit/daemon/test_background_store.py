# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_unit.daemon.background_store import BackgroundStore, Place
from edge_unit.pipeline import BackgroundModel
from edge_unit.sources.frame import CameraInfo
from shared.camera import Intrinsics
from shared.transforms import from_xyz_rpy

CAMERA = CameraInfo("A", "model", Intrinsics(8, 6, 10.0, 10.0, 4.0, 3.0))
POSE = from_xyz_rpy((1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
PLACE = Place(CAMERA, POSE)


@pytest.fixture
def reference() -> BackgroundModel:
    depth_m = np.random.default_rng(1).random((6, 8), dtype=np.float32)
    depth_m[0, 0] = np.nan
    return BackgroundModel(depth_m, np.full((6, 8), 0.01, np.float32), 60)


def test_a_background_comes_back(tmp_path: Path, reference: BackgroundModel) -> None:
    store = BackgroundStore(tmp_path / "state")
    assert store.load(PLACE) is None
    store.save(PLACE, reference)
    found = BackgroundStore(tmp_path / "state").load(PLACE)
    assert found is not None
    assert np.array_equal(found.depth_m, reference.depth_m, equal_nan=True)
    assert found.frames == 60
    store.drop()
    store.drop()
    assert store.load(PLACE) is None


@pytest.mark.parametrize(
    "other",
    [
        Place(replace(CAMERA, serial="B"), POSE),
        Place(replace(CAMERA, intrinsics=Intrinsics(8, 6, 11.0, 10.0, 4.0, 3.0)), POSE),
        Place(CAMERA, from_xyz_rpy((1.0, 2.0, 3.001), (0.1, 0.2, 0.3))),
    ],
)
def test_that_of_another_camera_profile_or_pose_is_not_used(
    tmp_path: Path, reference: BackgroundModel, other: Place
) -> None:
    store = BackgroundStore(tmp_path)
    store.save(PLACE, reference)
    assert store.load(other) is None
    assert store.load(PLACE) is not None


@pytest.mark.parametrize("name", ["background.npz", "background.json"])
@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b"\xff" * 20_000])
def test_a_damaged_one_is_not_used(tmp_path: Path, reference: BackgroundModel, name: str, content: bytes) -> None:
    store = BackgroundStore(tmp_path)
    store.save(PLACE, reference)
    (tmp_path / name).write_bytes(content)
    assert store.load(PLACE) is None


def test_images_of_one_and_label_of_another_do_not_go_together(tmp_path: Path, reference: BackgroundModel) -> None:
    store = BackgroundStore(tmp_path)
    store.save(PLACE, reference)
    label = (tmp_path / "background.json").read_bytes()
    store.save(PLACE, BackgroundModel(reference.depth_m + 1.0, reference.spread_m, 3))
    (tmp_path / "background.json").write_bytes(label)
    assert store.load(PLACE) is None


def test_a_full_disk_costs_the_file_and_not_the_unit(
    tmp_path: Path, reference: BackgroundModel, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    BackgroundStore(tmp_path / "file").save(PLACE, reference)
    assert "cannot be kept" in caplog.text
