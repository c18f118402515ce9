# SPDX-License-Identifier: Apache-2.0
"""The background model of one camera: started, given up, learned, loaded, dropped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edge_unit.daemon.background_learning import BackgroundLearning
from edge_unit.daemon.background_store import BackgroundStore, Place
from edge_unit.pipeline import DepthPipeline
from edge_unit.sources.frame import CameraInfo
from edge_unit.uplink.assignment import Trouble
from shared.camera import Intrinsics
from shared.cell import Cell
from shared.messages import Command, Outcome, OutcomeCode, Progress
from shared.transforms import look_at

CAMERA = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
POSE = look_at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0))
PLACE = Place(CameraInfo("A", "fake", CAMERA), POSE)
LEARN, DROP = Command(id=1, verb="learn_background"), Command(id=2, verb="drop_background")
DEPTH = np.full(CAMERA.shape, 1900, np.uint16)


class Student:
    """The background learning of one unit, and the outcomes of its commands."""

    def __init__(self, folder: Path, frames: int | None = None) -> None:
        self.told: list[tuple[int, OutcomeCode]] = []
        self.details: list[str] = []
        self.pipeline = DepthPipeline(CAMERA, POSE, Cell("bare", np.full(3, -1.0), np.full(3, 1.0)))
        store = BackgroundStore(folder)
        self.learning = BackgroundLearning(store, frames, self.finish)

    def finish(self, command: Command, outcome: Outcome) -> None:
        self.told.append((command.id, outcome.code))
        self.details.append(outcome.detail)

    def add(self) -> Trouble | None:
        return self.learning.add(self.pipeline, PLACE, DEPTH, None)


def test_a_learned_background_is_loaded_again_and_stays_dropped(tmp_path: Path) -> None:
    one = Student(tmp_path, frames=2)
    one.learning.find(one.pipeline, PLACE)
    assert one.learning.progress == (0, 2)
    learning = one.add()
    assert learning is not None
    assert (learning.code, learning.progress) == ("background", Progress(task="background", done=1, total=2))
    assert "frame 1 of 2" in learning.sentence
    assert one.add() is None
    assert one.learning.progress is None
    assert one.pipeline.reference is not None
    again = Student(tmp_path, frames=2)
    again.learning.find(again.pipeline, PLACE)
    assert again.learning.progress is None
    assert again.pipeline.reference is not None
    again.learning.drop(again.pipeline, DROP)
    assert again.pipeline.reference is None
    assert again.told == [(2, "done")]
    last = Student(tmp_path)
    last.learning.find(last.pipeline, PLACE)
    assert last.pipeline.reference is None
    assert last.add() is None


def test_each_command_gets_its_outcome(tmp_path: Path) -> None:
    one = Student(tmp_path, frames=1)
    one.learning.begin(one.pipeline, LEARN)
    one.learning.begin(one.pipeline, LEARN)
    assert one.add() is None
    assert one.told == [(1, "superseded"), (1, "done")]


def test_a_background_that_cannot_be_removed_costs_no_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = Student(tmp_path)

    def refuse(_: BackgroundStore) -> None:
        raise OSError("read-only file system")

    monkeypatch.setattr(BackgroundStore, "drop", refuse)
    one.learning.drop(one.pipeline, DROP)
    assert one.told == [(2, "failed")]
    assert "read-only file system" in one.details[0]
