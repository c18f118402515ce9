# SPDX-License-Identifier: Apache-2.0
"""The series for a monitoring system: counted with each update, or computed from the master at each scrape.

Labels are ids, addresses and states of at most `MAX_UNITS` units; names that a unit reports are only in `unit_info`.
"""

from __future__ import annotations

import importlib.metadata
from collections import Counter
from collections.abc import Iterator
from typing import get_args

from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from master_server.api.map_stream import Stream
from master_server.api.responses import coverage_shares
from master_server.core import Master
from master_server.security import Limits
from shared.clock import NS_PER_S, monotonic_ns
from shared.messages import State

VERSION = importlib.metadata.version("cellwatch")
"""Read from disk once, since an event loop should not do it."""

BOUNDS_S = (0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1)
"""Buckets of the histogram: from an update of a few voxels to one that made fifty others wait."""

UNIT = ("unit", "ip")


class Metrics(Collector):
    """All series of one master, in its own registry."""

    def __init__(self, master: Master, stream: Stream, limits: Limits) -> None:
        self._master = master
        self._stream = stream
        self._limits = limits
        self._took = Histogram(
            "cellwatch_update_seconds",
            "Time from an update's last byte to its answer.",
            buckets=BOUNDS_S,
            registry=None,
        )
        self._refused: dict[int, int] = {}
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def accepted(self, unit_id: int, size_bytes: int, took_ns: int) -> None:
        """Count an accepted update: `size_bytes` of body, `took_ns` from its last byte to the answer."""
        slot = self._master.registry.get(unit_id)
        slot.updates += 1
        slot.received_bytes += size_bytes
        self._took.observe(took_ns / NS_PER_S)

    def refused(self, status: int) -> None:
        """Count a refused update; `status` is one of the master's few."""
        self._refused[status] = self._refused.get(status, 0) + 1

    def exposition(self) -> bytes:
        """Return all series now, as Prometheus text."""
        return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """Yield all families; the registry calls it."""
        now_ns = monotonic_ns()
        yield from self._units(now_ns)
        yield from self._updates()
        yield from self._map(now_ns)
        build = GaugeMetricFamily("cellwatch_build_info", "The running version.", labels=("version",))
        build.add_metric((VERSION,), 1.0)
        yield build

    def _units(self, now_ns: int) -> Iterator[Metric]:
        def gauge(name: str, text: str, labels: tuple[str, ...] = UNIT) -> GaugeMetricFamily:
            return GaugeMetricFamily(f"cellwatch_unit_{name}", text, labels=labels)

        info = gauge(
            "info", "Model, serial and software as the unit reports them.", (*UNIT, "serial", "model", "software")
        )
        states = gauge("state", "1 for the present state of the unit.", (*UNIT, "state"))
        age = gauge("age_seconds", "Age of its last frame since the capture.")
        arrival_age = gauge("arrival_age_seconds", "Time since its last update arrived.")
        fps = gauge("fps", "Frames per second that it reports.")
        voxels = gauge("voxels", "Obstacle voxels in its last report.")
        process = gauge("process_seconds", "Time from a frame to its voxels, at the unit.")
        updates = CounterMetricFamily("cellwatch_unit_updates", "Accepted updates.", labels=UNIT)
        received = CounterMetricFamily("cellwatch_unit_received_bytes", "Bodies of those updates.", labels=UNIT)
        for slot in self._master.registry:
            unit = (str(slot.id), slot.ip)
            state, _ = self._master.judge(slot, now_ns)
            info.add_metric((*unit, slot.serial, slot.record.model, slot.record.software), 1.0)
            for one in get_args(State):
                states.add_metric((*unit, one), float(one == state))
            for family, value in ((age, slot.session.age_s(now_ns)), (arrival_age, slot.session.arrival_age_s(now_ns))):
                if value is not None:
                    family.add_metric(unit, value)
            fps.add_metric(unit, slot.session.fps)
            voxels.add_metric(unit, len(self._master.map.keys_of(slot.id)))
            process.add_metric(unit, slot.session.health.process_ms / 1000.0)
            updates.add_metric(unit, slot.updates)
            received.add_metric(unit, slot.received_bytes)
        yield from (info, states, age, arrival_age, fps, voxels, process, updates, received)

    def _updates(self) -> Iterator[Metric]:
        yield from self._took.collect()
        refused = CounterMetricFamily("cellwatch_updates_refused", "Updates refused, by status.", labels=("status",))
        for status, count in sorted(self._refused.items()):
            refused.add_metric((str(status),), count)
        yield refused
        turned_away = CounterMetricFamily(
            "cellwatch_turned_away", "Requests and connections beyond the limits.", labels=("what",)
        )
        for what, count in self._limits.turned_away.items():
            turned_away.add_metric((what,), count)
        yield turned_away
        yield GaugeMetricFamily("cellwatch_connections", "Open connections.", self._limits.connections)

    def _map(self, now_ns: int) -> Iterator[Metric]:
        view = self._master.view(now_ns)
        incomplete = GaugeMetricFamily(
            "cellwatch_map_incomplete", "Reasons why the map is not complete, by code.", labels=("code",)
        )
        for code, count in sorted(Counter(cause.code for cause in view.causes).items()):
            incomplete.add_metric((code,), count)
        yield incomplete
        seen_share = 1.0 - coverage_shares(self._master.seen_by(now_ns))[0]
        yield GaugeMetricFamily("cellwatch_map_voxels", "Obstacle voxels in the merged map.", len(view.keys))
        yield GaugeMetricFamily("cellwatch_map_complete", "1 when the map is complete.", float(view.complete))
        yield GaugeMetricFamily("cellwatch_seen_share", "Share of the cell's blocks that live units see.", seen_share)
        yield GaugeMetricFamily("cellwatch_units", "Units that have a slot.", len(self._master.registry))
        yield GaugeMetricFamily("cellwatch_units_live", "Units that are live.", view.units_live)
        yield GaugeMetricFamily("cellwatch_stream_readers", "Readers of the stream.", len(self._stream))
        robot_age_s = self._master.robot.age_s(now_ns)
        if robot_age_s is not None:
            yield GaugeMetricFamily("cellwatch_robot_age_seconds", "Time since the robot's last joints.", robot_age_s)
