# SPDX-License-Identifier: Apache-2.0
"""A refresh composed as if each unit had a computer of its own, in turns with the centralised ways.

Its parts are measured one at a time, so two cores are enough to predict five computers.
"""

from __future__ import annotations

import gc
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper_experiment.book import ONE_OCTREE, ONE_PROCESS, Book, in_mm
from benchmarks.paper_experiment.contenders import Centralised, IntoOctree, prepared
from benchmarks.paper_experiment.master import MapReader, Member, Rush, Site, keys_of
from benchmarks.paper_experiment.scene import CAMERAS, Views
from master_server.core import MergedMap
from shared.clock import NS_PER_MS, monotonic_ns, stage_ns
from shared.errors import UplinkError
from shared.wire import encode_update

OCTREE_S = 15.0
"""Per resolution and voxel size: no further refresh of the octree begins after it, because one may take seconds."""


@dataclass(eq=False)
class Parts:
    """Parts of the refreshes of one resolution and voxel size: (rounds, cameras) milliseconds each, and bytes.

    Attributes:
        unit_ms: a unit's work on its frame.
        trip_ms: its update, by its client, there and back.
        rush_ms: updates of so many units at once, until the last is answered.
        merge_ms: merge of the voxels of so many units, which the master does at the next request.
        map_ms: a robot's GET /voxels of so many units. No part of a refresh, because the centralised ways pay it, too.
        update_bytes: size of the units' updates.
    """

    resolution: str
    voxel_mm: int
    unit_ms: list[list[float]] = field(default_factory=list)
    trip_ms: list[list[float]] = field(default_factory=list)
    rush_ms: list[list[float]] = field(default_factory=list)
    merge_ms: list[list[float]] = field(default_factory=list)
    map_ms: list[list[float]] = field(default_factory=list)
    update_bytes: list[list[int]] = field(default_factory=list)
    voxels: list[int] = field(default_factory=list)

    def refresh_ms(self) -> NDArray[np.float64]:
        """Return the refreshes (rounds, cameras) of one camera, two, and so on."""
        slowest = np.maximum.accumulate(np.array(self.unit_ms) + np.array(self.trip_ms), axis=1)
        return np.asarray(slowest + self.waited_ms() + np.array(self.merge_ms))

    def waited_ms(self) -> NDArray[np.float64]:
        """Return the additional time (rounds, cameras) of so many simultaneous updates compared with one."""
        rush = np.array(self.rush_ms)
        return np.asarray(np.maximum(rush - rush[:, :1], 0.0))

    def alone_ms(self) -> NDArray[np.float64]:
        """Return the refreshes (rounds, cameras) of each camera as if it were the only one."""
        return np.asarray(np.array(self.unit_ms) + np.array(self.trip_ms) + np.array(self.merge_ms)[:, :1])


class Bench:
    """One resolution before a master."""

    def __init__(self, site: Site, views: Views, name: str, book: Book) -> None:
        """Record the refreshes in `book` under `name`."""
        self._site, self._views, self._name, self._book = site, views, name, book
        self._work = prepared(views, 0.05)
        self._centralised = Centralised(self._work)
        self._members = [Member.at(site.url, site.unit_token, number) for number in range(CAMERAS)]

    async def run(self, sizes_m: Sequence[float], rounds: int, octree_rounds: Mapping[float, int]) -> list[Parts]:
        """Run `rounds` rounds for each voxel size, in some of them also the octree. Return the parts of each size."""
        found = []
        for member in self._members:
            await member.client.__aenter__()
        try:
            octree = IntoOctree(self._views, self._work) if octree_rounds else None
            for size_m in sizes_m:
                found.append(await self._size(size_m, rounds, octree, octree_rounds.get(size_m, 0)))
        finally:
            for member in self._members:
                await member.client.__aexit__(None, None, None)
        return found

    async def _size(self, size_m: float, rounds: int, octree: IntoOctree | None, octree_rounds: int) -> Parts:
        views, site = self._views, self._site
        await site.change_voxel_size(size_m)
        for member, work, pose in zip(self._members, self._work, views.poses, strict=True):
            work.resize(size_m)
            await member.register(views.intrinsics, pose)
        if octree is not None:
            octree.resize(size_m)
        parts = Parts(views.name, in_mm(size_m))
        self._merged = MergedMap(self._work[0].pipeline.lattice)
        # As in the daemon, existing objects are exempt from garbage collection.
        gc.collect()
        gc.freeze()
        with (
            closing(MapReader(site.url, site.unit_token)) as reader,
            closing(Rush(site.url, site.head, self._members)) as rush,
        ):
            # Compiles the missing kernels. That takes longer than the master keeps a silent connection.
            self._centralised.refresh(views, 0)
            rush.connect()
            await self._round(Parts(views.name, in_mm(size_m)), 0, reader, rush)
            octree_ms = 0.0
            for number in range(rounds):
                n = number % views.frames
                merged = await self._round(parts, n, reader, rush)
                self._book.add(self._name, views.name, size_m, parts.refresh_ms()[-1])
                self._book.add(ONE_PROCESS, views.name, size_m, self._centralised.refresh(views, n))
                if not np.array_equal(merged, self._centralised.merged):
                    raise UplinkError(f"the master's map has {len(merged)} voxels, one process found others")
                if octree is not None and number < octree_rounds and octree_ms < 1e3 * OCTREE_S:
                    until_ms = octree.refresh(n)
                    octree_ms += until_ms[-1]
                    self._book.add(ONE_OCTREE, views.name, size_m, until_ms)
                    await self._connect_anew(reader, rush)
        return parts

    async def _connect_anew(self, reader: MapReader, rush: Rush) -> None:
        """Reconnect after a pause in which the master closed all silent connections."""
        reader.close()
        reader.read()
        rush.connect()
        for member in self._members:
            await member.report(None, monotonic_ns())

    async def _round(self, parts: Parts, n: int, reader: MapReader, rush: Rush) -> NDArray[np.uint32]:
        """Measure all parts once, at moment `n`. Return the map of all cameras."""
        views = self._views
        sights, unit_ms, trip_ms = [], [], []
        for camera, (work, member) in enumerate(zip(self._work, self._members, strict=True)):
            began_ns = stage_ns()
            sight = work.filter_frame(views.depth[camera, n], views.joints[n])
            filtered_ns = stage_ns()
            await member.report(sight, monotonic_ns())
            reported_ns = stage_ns()
            sights.append(sight)
            unit_ms.append((filtered_ns - began_ns) / NS_PER_MS)
            trip_ms.append((reported_ns - filtered_ns) / NS_PER_MS)
        rush.run([None] * CAMERAS)
        rush_ms, merge_ms, map_ms, merged = [], [], [], self._merged
        for count in range(1, CAMERAS + 1):
            merged.withdraw(count)
        for count in range(1, CAMERAS + 1):
            rush_ms.append(rush.run(sights[:count]))
            merged.replace(count, sights[count - 1].voxels)
            began_ns = stage_ns()
            expected, _ = merged.voxels()
            merge_ms.append((stage_ns() - began_ns) / NS_PER_MS)
            began_ns = stage_ns()
            body = reader.read()
            map_ms.append((stage_ns() - began_ns) / NS_PER_MS)
            if not np.array_equal(keys_of(body), expected):
                raise UplinkError(f"{count} units: expected {len(expected)} voxels in the map, got others")
        parts.unit_ms.append(unit_ms)
        parts.trip_ms.append(trip_ms)
        parts.rush_ms.append(rush_ms)
        parts.merge_ms.append(merge_ms)
        parts.map_ms.append(map_ms)
        parts.update_bytes.append(
            [len(encode_update(m.update(s, monotonic_ns()))) for m, s in zip(self._members, sights, strict=True)]
        )
        parts.voxels.append(len(expected))
        return expected
