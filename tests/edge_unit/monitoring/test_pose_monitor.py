# SPDX-License-Identifier: Apache-2.0
"""A camera of the demo cell, knocked, covered, turned away and passed by, as its unit judges it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_unit.monitoring import PoseMonitor, Verdict, place_of
from edge_unit.monitoring.pose_monitor import BASELINE_LOOKS, FILE_NAME, OLD_FILE_NAME, PERIOD_S, WINDOW
from edge_unit.pipeline import DepthPipeline, Misfit
from shared.transforms import Transform, from_xyz_rpy
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.world.world import World
from tests.edge_unit.scenes import demo_cell

EYE = d435i_intrinsics(424, 240)
HERE = np.eye(4)


class Watched:
    """Camera `number` of the demo rig in a world with two people, judged every `PERIOD_S`."""

    def __init__(self, folder: Path, number: int = 0) -> None:
        self.folder = folder
        self.number = number
        self.pose = rig(demo_cell(), 4)[number]
        self.world = World.demo(people=2, seed=3, cell=demo_cell())
        self.pipeline = DepthPipeline(EYE, self.pose, demo_cell())
        self.t_s = 0.0
        self.restart()

    def restart(self) -> None:
        """Start anew, like a unit that was switched off and on."""
        self.stance = PoseMonitor(self.folder)
        self.stance.begin(place_of("SERIAL", EYE.shape, self.pose))

    def looks(self, count: int, knock: Transform = HERE, share: float = 1.0) -> Iterator[Verdict]:
        """Yield verdicts of `count` checks from `knock` beside its place; the image right of `share` is covered."""
        eye = SimulatedCamera(self.world, self.pose @ knock, EYE, seed=self.number)
        for _ in range(count):
            frame = eye.capture(self.t_s)
            depth = frame.depth.copy()
            depth[:, round(share * EYE.width) :] = 0
            self.misfit = self.pipeline.process(depth, frame.joints, with_misfit=True).misfit
            yield self.stance.watch(self.misfit, self.pipeline.static_version, round(self.t_s * 1e9))
            self.stance.save()
            self.t_s += PERIOD_S

    def last(self, count: int, knock: Transform = HERE, share: float = 1.0) -> Verdict:
        return list(self.looks(count, knock, share))[-1]


@pytest.fixture
def watched(tmp_path: Path) -> Watched:
    watched = Watched(tmp_path)
    assert set(watched.looks(2 * BASELINE_LOOKS)) == {Verdict()}
    return watched


KNOCKS = {
    "1 degree": from_xyz_rpy((0, 0, 0), np.radians((0.6, -0.6, 0.53))),
    "20 mm": from_xyz_rpy((0.012, -0.012, 0.0106), (0, 0, 0)),
    "5 degrees": from_xyz_rpy((0, 0, 0), np.radians((0.0, 5.0, 0.0))),
    "30 degrees": from_xyz_rpy((0, 0, 0), np.radians((0.0, 0.0, 30.0))),
}


@pytest.mark.parametrize("knock", KNOCKS)
def test_a_knocked_camera_is_reported_within_two_seconds_and_recovers(watched: Watched, knock: str) -> None:
    reasons = [verdict.reason for verdict in watched.looks(WINDOW, KNOCKS[knock])]
    assert reasons[-1]
    assert PERIOD_S * WINDOW < 2.0
    assert watched.last(20, KNOCKS[knock]).reason, "it does not get used to it"
    assert watched.last(WINDOW + 1) == Verdict()


def test_a_camera_that_was_knocked_while_its_unit_was_off(watched: Watched) -> None:
    watched.restart()
    assert watched.last(WINDOW, KNOCKS["1 degree"]).moved
    watched.restart()
    assert watched.last(WINDOW) == Verdict()


def test_another_place_begins_anew(watched: Watched) -> None:
    watched.stance.begin(place_of("ANOTHER", EYE.shape, watched.pose))
    assert watched.last(WINDOW, KNOCKS["1 degree"]) == Verdict()


def test_a_covered_lens_is_blind_and_half_of_one_is_not(watched: Watched) -> None:
    assert watched.last(WINDOW, share=0.7) == Verdict()
    assert "covered or dazzled" in watched.last(WINDOW, share=0.1).blind
    assert watched.last(WINDOW + 1) == Verdict()


def test_a_changed_cell_changes_no_verdict_by_itself(watched: Watched) -> None:
    watched.pipeline.use_cell(demo_cell())
    assert set(watched.looks(BASELINE_LOOKS)) == {Verdict()}
    watched.pipeline.use_cell(demo_cell())
    assert watched.last(WINDOW, KNOCKS["1 degree"]).moved


def test_a_known_object_that_was_carried_away_is_no_doubt_about_the_camera(watched: Watched) -> None:
    cell = demo_cell()
    assert cell.objects
    there = from_xyz_rpy((0.2, 0.3, 0.0), (0.0, 0.0, 0.5))
    elsewhere = replace(cell, objects=tuple(replace(each, T_world_mesh=there) for each in cell.objects))
    watched.pipeline.adopt(elsewhere, watched.pipeline.settings)
    assert set(watched.looks(BASELINE_LOOKS)) == {Verdict()}


def test_a_pose_that_was_wrong_from_the_beginning_is_a_warning(tmp_path: Path) -> None:
    watched = Watched(tmp_path)
    off = from_xyz_rpy((0, 0, 0), np.radians((0.9, 0.0, 0.0)))
    verdict = watched.last(BASELINE_LOOKS + WINDOW, off)
    assert "degrees off" in verdict.warning or "mm off" in verdict.warning
    assert not verdict.reason


@pytest.mark.parametrize("number", ["NaN", "1e999", "1" + "0" * 400])
@pytest.mark.parametrize("name", ["looks", "slope", "curvature", "valid_share", "beyond_share"])
def test_a_fit_that_is_no_number_is_passed_over(watched: Watched, name: str, number: str) -> None:
    file = watched.folder / FILE_NAME
    document = json.loads(file.read_text())
    document[name] = [0.5] * 6 if name in ("slope", "curvature") else 0.5
    file.write_text(json.dumps(document).replace("0.5", number))
    watched.restart()
    assert watched.stance._usual is None
    assert set(watched.looks(BASELINE_LOOKS)) == {Verdict()}


@pytest.mark.parametrize("text", ["", "{}", '{"place": 1', "[]", "x" * 20_000])
def test_a_damaged_file_is_passed_over(watched: Watched, text: str) -> None:
    (watched.folder / FILE_NAME).write_text(text)
    watched.restart()
    assert set(watched.looks(BASELINE_LOOKS)) == {Verdict()}


def test_the_file_of_former_versions_is_read(watched: Watched) -> None:
    usual = watched.stance._usual
    assert usual is not None
    (watched.folder / FILE_NAME).rename(watched.folder / OLD_FILE_NAME)
    watched.restart()
    assert watched.stance._usual is not None
    assert watched.stance._usual.slope == pytest.approx(usual.slope)
    watched.last(2 * BASELINE_LOOKS)
    assert (watched.folder / FILE_NAME).exists()
    (watched.folder / OLD_FILE_NAME).write_text("{}")
    watched.restart()
    assert watched.stance._usual is not None


def test_without_known_surfaces_there_is_no_verdict(watched: Watched) -> None:
    watched.stance.judge(misfit_of(watched), 99, 0)
    bare = replace(misfit_of(watched), static_share=0.0, slope=np.full(6, 0.5))
    verdicts = {watched.stance.judge(bare, 99, n) for n in range(WINDOW)}
    assert verdicts == {Verdict()}


def misfit_of(watched: Watched) -> Misfit:
    """Return the misfit of a frame in which nothing is out of place."""
    list(watched.looks(1))
    assert watched.misfit is not None
    return watched.misfit


def test_checks_are_due_after_a_period_and_after_a_clock_restart(tmp_path: Path) -> None:
    stance = PoseMonitor(tmp_path)
    look = Misfit(np.zeros(6), np.ones(6), 1.0, 0.0, 1.0)
    assert stance.due(10_000_000_000)
    stance.judge(look, 0, 10_000_000_000)
    assert not stance.due(10_100_000_000)
    assert stance.due(10_200_000_000)
    assert stance.due(5)
