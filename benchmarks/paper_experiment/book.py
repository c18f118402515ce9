# SPDX-License-Identifier: Apache-2.0
"""Measurements by contender, resolution, voxel size and number of cameras."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

UNITS_COMPOSED = "distributed, composed"
UNITS_RUNNING = "distributed, as it runs on this machine"
ONE_PROCESS = "centralised, the same filter"
ONE_PROCESS_BESIDE = "centralised, the same filter, in turns with processes"
ONE_OCTREE = "centralised, as MoveIt's updaters"
UNITS_SAME_FRAMES = "distributed, composed, all cameras with the same frames"

CONTENDERS = {
    UNITS_COMPOSED: "Each unit's work (process()) on a core of its own, then its update by the units' own client "
    "over HTTP on loopback to a real master; the slowest unit counts. Two times are added: the "
    "additional time of all updates at the same moment compared with one, and the master's merge.",
    UNITS_RUNNING: "One process for each unit and one for the master, which share the cores of this machine. The "
    "time runs from handing all units their frames at once until GET /voxels returns a map that "
    "holds all of them.",
    ONE_PROCESS: "The pipelines of all cameras in turn in one process on one core, and the master's own merge "
    "there. In its favour: the depth images are already in its memory.",
    ONE_PROCESS_BESIDE: "The same, measured in turns with the processes, not pinned to a core.",
    ONE_OCTREE: "All cameras in turn on one core: CAD and robot masked out of the depth image, points, "
    "OctoMap.insertPointCloud with free-space rays (discretized) into one octree. In its favour: no "
    "rays to CAD and robot, which MoveIt casts, and no other user of the octree's lock.",
    UNITS_SAME_FRAMES: "As composed, but all cameras have the frames of the first one, so that only their number "
    "changes.",
}


class Key(NamedTuple):
    """Identifies one measurement."""

    contender: str
    resolution: str
    voxel_mm: int
    cameras: int


@dataclass(frozen=True)
class Spread:
    """Statistics in milliseconds over several refreshes."""

    median_ms: float
    p99_ms: float
    least_ms: float
    most_ms: float
    samples: int


class Book:
    """Collects the times of refreshes in milliseconds."""

    def __init__(self) -> None:
        self._samples: dict[Key, list[float]] = {}

    def add(self, contender: str, resolution: str, voxel_size_m: float, until_ms: Iterable[float]) -> None:
        """Add the times of one round: the refresh of one camera, of two, and so on."""
        for cameras, value in enumerate(until_ms, 1):
            self._samples.setdefault(Key(contender, resolution, in_mm(voxel_size_m), cameras), []).append(value)

    def __contains__(self, key: object) -> bool:
        return key in self._samples

    def spread(self, key: Key) -> Spread:
        """Return the statistics of `key`.

        Raises:
            KeyError: nothing was measured.
        """
        values = self._samples[key]
        median, p99 = np.percentile(values, (50, 99))
        return Spread(float(median), float(p99), min(values), max(values), len(values))

    def median(self, contender: str, resolution: str, voxel_mm: int, cameras: int) -> float:
        """Return a median in milliseconds; NaN if nothing was measured."""
        key = Key(contender, resolution, voxel_mm, cameras)
        return self.spread(key).median_ms if key in self else float("nan")

    def __iter__(self) -> Iterator[Key]:
        """Iterate over all measurements, in the order in which they were begun."""
        return iter(self._samples)

    def rows(self) -> list[dict[str, Any]]:
        """Return all measurements as plain values."""
        found = []
        for key in self._samples:
            spread = self.spread(key)
            figures = {name: round(value, 4) for name, value in spread.__dict__.items() if name != "samples"}
            found.append({**key._asdict(), **figures, "samples": spread.samples})
        return found


def in_mm(voxel_size_m: float) -> int:
    """Return a voxel's edge in whole millimetres."""
    return round(1e3 * voxel_size_m)
