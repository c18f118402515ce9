# SPDX-License-Identifier: Apache-2.0
"""`make bench-pose-monitor`: measure the time until a knocked or covered camera is reported, and the rate of false
alarms.

The cameras of the demo cell have a D435i's faults. People walk and reach before them, and the robot moves. A false
alarm is a check in which an untouched camera is reported as moved or blind.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.reporting.report import RESULTS, Mark, Result, line, write
from benchmarks.sweeps import runner
from edge_unit.monitoring import PoseMonitor
from edge_unit.monitoring.pose_monitor import BASELINE_LOOKS_MAX, PERIOD_S, WINDOW
from edge_unit.pipeline import DepthPipeline
from shared.camera import Intrinsics
from shared.transforms import Transform, from_xyz_rpy
from simulation.cameras.camera import SimulatedCamera, d435i_intrinsics, rig
from simulation.world.world import World

CAMERAS = 4

REPORTED_S_MAX = 2.0

CHECKS_AFTER = 12
"""Checks after a knock. A knock that is not reported by then counts as missed: longer than `REPORTED_S_MAX`."""

KNOCKS = {
    "turned by 1 degree": (np.radians(1.0), 0.0),
    "shifted by 20 mm": (0.0, 0.02),
    "turned by 2 degrees": (np.radians(2.0), 0.0),
    "shifted by 50 mm": (0.0, 0.05),
    "turned by 5 degrees": (np.radians(5.0), 0.0),
    "turned by 20 degrees": (np.radians(20.0), 0.0),
    "turned by 60 degrees": (np.radians(60.0), 0.0),
    "covered": (0.0, 0.0),
    "dazzled over two thirds": (0.0, 0.0),
}
"""Rotation in rad and shift in m, each in a random direction."""

COVERED = {"covered": 1.0, "dazzled over two thirds": 0.67}
"""Share of the image, from the left, that has no measurement."""


@dataclass(frozen=True)
class KnockTimes:
    """Results of one camera: per knock, seconds until it was reported (NaN: never) and until the report ended."""

    reported_s: dict[str, list[float]]
    back_s: dict[str, list[float]]
    quiet_looks: int
    alarms: list[str]


class WatchedCamera:
    """One camera, checked as its unit checks it."""

    def __init__(self, number: int, people: int, intrinsics: Intrinsics, folder: Path) -> None:
        self.world = World.demo(people=people, seed=number)
        self.pose = rig(self.world.cell, CAMERAS)[number]
        self.intrinsics = intrinsics
        self.number = number
        self.pipeline = DepthPipeline(intrinsics, self.pose, self.world.cell)
        self.stance = PoseMonitor(folder)
        self.stance.begin("here")
        self.t_s = 0.0

    def check(self, eye: SimulatedCamera, hidden: float = 0.0) -> str:
        """Run one check. Return the reason if the view is not trusted, else an empty text."""
        frame = eye.capture(self.t_s)
        depth = frame.depth
        if hidden:
            depth = depth.copy()
            depth[:, : round(hidden * self.intrinsics.width)] = 0
        found = self.pipeline.process(depth, frame.joints, with_misfit=True)
        verdict = self.stance.watch(found.misfit, self.pipeline.static_version, round(self.t_s * 1e9))
        self.t_s += PERIOD_S
        return verdict.reason

    def eye(self, knock: Transform) -> SimulatedCamera:
        """Return the camera, displaced by `knock` from its place."""
        return SimulatedCamera(self.world, self.pose @ knock, self.intrinsics, seed=self.number)

    def seconds_until(self, reported: bool, eye: SimulatedCamera, hidden: float) -> float:
        """Return the seconds until the view is reported as not trusted, or as trusted again."""
        for checks in range(1, CHECKS_AFTER + 1):
            if bool(self.check(eye, hidden)) == reported:
                return checks * PERIOD_S
        return float("nan")


def watch(number: int, people: int, size: tuple[int, int], quiet_s: float, trials: int) -> KnockTimes:
    """Run all trials of one camera."""
    rng = np.random.default_rng(number)
    with tempfile.TemporaryDirectory(prefix="cellwatch-stance-") as folder:
        one = WatchedCamera(number, people, d435i_intrinsics(*size), Path(folder))
        still = one.eye(np.eye(4))
        quiet = [one.check(still) for _ in range(max(round(quiet_s / PERIOD_S), BASELINE_LOOKS_MAX))]
        reported_s: dict[str, list[float]] = {name: [] for name in KNOCKS}
        back_s: dict[str, list[float]] = {name: [] for name in KNOCKS}
        for name, (turn_rad, shift_m) in KNOCKS.items():
            for _ in range(trials):
                knock = from_xyz_rpy(shift_m * _direction(rng), turn_rad * _direction(rng))
                reported_s[name].append(one.seconds_until(True, one.eye(knock), COVERED.get(name, 0.0)))
                back_s[name].append(one.seconds_until(False, still, 0.0))
                one.t_s += float(rng.uniform(0.0, 20.0))
        return KnockTimes(reported_s, back_s, len(quiet), [reason for reason in quiet if reason])


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, then print the table, the marks and one line of JSON. The exit code is 1 when a mark is missed."""
    options = _parser().parse_args(arguments)
    jobs = [
        partial(watch, number, people, options.resolution, 3600.0 * options.hours / 2.0, options.trials)
        for people in (1, 2)
        for number in range(CAMERAS)
    ]
    with runner(options.processes) as run:
        found: list[KnockTimes] = run(jobs)
    rows = []
    marks = []
    for name in KNOCKS:
        reported = np.array([seconds for one in found for seconds in one.reported_s[name]])
        back = np.array([seconds for one in found for seconds in one.back_s[name]])
        late = float(np.mean(~(reported <= REPORTED_S_MAX)))
        rows.append(
            (name, len(reported), float(np.nanmedian(reported)), float(np.nanmax(reported)), 100.0 * late, _worst(back))
        )
        marks.append(Mark(f"{name}: % not reported within {REPORTED_S_MAX:g} s", 100.0 * late, at_most=0.0))
    hours = sum(one.quiet_looks for one in found) * PERIOD_S / 3600.0
    alarms = [reason for one in found for reason in one.alarms]
    marks.append(Mark("false alarms, looks", float(len(alarms)), at_most=0.0))
    size = "{}x{}".format(*options.resolution)
    checks = f"{len(alarms)} of {round(hours * 3600.0 / PERIOD_S)} checks in {hours:.2f} camera hours were false alarms"
    result = Result(
        f"Cameras knocked, covered and dazzled while one or two people walk, {size}",
        ("what", "trials", "told s, median", "worst", "% late", "over s, worst"),
        tuple(rows),
        tuple(marks),
        (checks, *sorted(set(alarms))),
    )
    print(result)
    document = result.document() | {
        "resolution": size,
        "camera_hours": hours,
        "false_alarm_looks": len(alarms),
        "seconds_to_notice_max": max((row[3] for row in rows), default=float("nan")),
        "passed": all(mark.met for mark in marks),
    }
    write("pose_monitor", document, options.results)
    print(line(document))
    return 0 if document["passed"] else 1


def _direction(rng: np.random.Generator) -> NDArray[np.float64]:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def _worst(seconds: NDArray[np.float64]) -> float:
    """Return the longest time. A time that did not end counts as the longest wait."""
    return float(np.max(np.where(np.isnan(seconds), CHECKS_AFTER * PERIOD_S, seconds)))


def _size(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make bench-pose-monitor", description="Measure knocked, covered and untouched cameras."
    )
    parser.add_argument("--hours", type=float, default=0.1, help="hours of each of the four cameras, untouched (0.1)")
    parser.add_argument("--trials", type=int, default=4, help="trials of each knock, camera and number of people (4)")
    parser.add_argument("--resolution", type=_size, default=(424, 240), metavar="WxH", help="(424x240)")
    parser.add_argument("--processes", type=int, default=2, help="number of processes (2)")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="folder for pose_monitor.json")
    return parser


assert CHECKS_AFTER > WINDOW

if __name__ == "__main__":
    sys.exit(main())
