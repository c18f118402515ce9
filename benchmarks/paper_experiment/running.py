# SPDX-License-Identifier: Apache-2.0
"""Units and a master as processes on this one machine, from frames for all at once to a map that holds them."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper_experiment.book import ONE_PROCESS_BESIDE, UNITS_RUNNING, Book
from benchmarks.paper_experiment.contenders import Centralised, UnitWork, prepared
from benchmarks.paper_experiment.master import MapReader, Site, keys_of
from benchmarks.paper_experiment.scene import CAMERAS, Views
from benchmarks.paper_experiment.unit import Command, FilterFrame, Resize, UseCamera, run
from shared.clock import NS_PER_MS, stage_ns
from shared.errors import UplinkError

ANSWER_S = 240.0
"""Time limit for a unit's command: on a busy machine it may have to compile first."""

END_S = 5.0
"""Time limit for a unit's process to end."""


@dataclass(eq=False)
class Units:
    """Processes of units, and the pipes that carry their commands."""

    pipes: list[Connection]

    def send_all(self, commands: Sequence[Command]) -> None:
        """Send one command to each of the first units, and wait until all are done.

        Raises:
            UplinkError: a unit ended, or did not finish in time.
        """
        chosen = self.pipes[: len(commands)]
        for pipe, command in zip(chosen, commands, strict=True):
            pipe.send(command)
        for number, pipe in enumerate(chosen):
            if not pipe.poll(ANSWER_S):
                raise UplinkError(
                    f"unit {number} did not finish its command within {ANSWER_S:g} s; see its output above"
                )
            try:
                pipe.recv()
            except EOFError as error:
                raise UplinkError(f"unit {number} ended; see its output above") from error


@contextmanager
def running(site: Site) -> Iterator[Units]:
    """Start one unit per camera. They end with the context."""
    context = multiprocessing.get_context("spawn")
    ours, processes = [], []
    for number in range(CAMERAS):
        here, there = context.Pipe()
        process = context.Process(target=run, args=(there, site.url, site.unit_token, number), daemon=True)
        process.start()
        there.close()
        ours.append(here)
        processes.append(process)
    try:
        yield Units(ours)
    finally:
        for here in ours:
            try:
                here.send(None)
            except OSError:
                # The process ended by itself.
                continue
        for process in processes:
            process.join(END_S)
            if process.is_alive():
                process.kill()
                process.join()


class Bench:
    """One resolution, with all units on it."""

    def __init__(self, site: Site, units: Units, views: Views, folder: Path, book: Book) -> None:
        self._site, self._units, self._views, self._book = site, units, views, book
        self._work = prepared(views, 0.05)
        self._centralised = Centralised(self._work)
        commands: list[Command] = []
        for camera, pose in enumerate(views.poses):
            path = folder / f"{views.name}-{camera}.npy"
            np.save(path, views.depth[camera])
            commands.append(UseCamera(views.intrinsics, pose, path, views.joints))
        units.send_all(commands)

    async def run(self, sizes_m: Sequence[float], rounds: int) -> None:
        """Run `rounds` rounds for each voxel size, in turns with all cameras in one process."""
        for size_m in sizes_m:
            await self._site.change_voxel_size(size_m)
            for work in self._work:
                work.resize(size_m)
            self._units.send_all([Resize(size_m)] * CAMERAS)
            expected = [
                [_keys(work, self._views, i, n) for n in range(self._views.frames)] for i, work in enumerate(self._work)
            ]
            with closing(MapReader(self._site.url, self._site.unit_token)) as reader:
                self._refresh(1, 0, reader, expected)
                for number in range(rounds):
                    n = number % self._views.frames
                    until_ms = [self._refresh(count, n, reader, expected) for count in range(1, CAMERAS + 1)]
                    self._book.add(UNITS_RUNNING, self._views.name, size_m, until_ms)
                    centralised_ms = self._centralised.refresh(self._views, n)
                    self._book.add(ONE_PROCESS_BESIDE, self._views.name, size_m, centralised_ms)

    def _refresh(self, count: int, n: int, reader: MapReader, expected: list[list[NDArray[np.uint32]]]) -> float:
        """Return the milliseconds until the map holds exactly what the first `count` units see at moment `n`."""
        self._units.send_all([FilterFrame(None)] * CAMERAS)
        began_ns = stage_ns()
        self._units.send_all([FilterFrame(n)] * count)
        body = reader.read()
        spent_ms = (stage_ns() - began_ns) / NS_PER_MS
        right = np.unique(np.concatenate([keys[n] for keys in expected[:count]]))
        if not np.array_equal(keys_of(body), right):
            raise UplinkError(f"{count} units: expected {len(right)} voxels in the map, got others")
        return spent_ms


def _keys(work: UnitWork, views: Views, camera: int, n: int) -> NDArray[np.uint32]:
    return work.filter_frame(views.depth[camera, n], views.joints[n]).voxels
