# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib.metadata
from contextlib import suppress

import pytest
from prometheus_client.parser import text_string_to_metric_families

from master_server.api.map_stream import Stream
from master_server.api.metrics import Metrics
from master_server.core.units import MAX_UNITS
from master_server.security import Limits
from master_server.security.rate_limits import CONNECTIONS_PER_ADDRESS, REQUESTS_BURST
from shared.clock import NS_PER_US, monotonic_ns
from shared.errors import Refusal
from shared.messages import JointsRequest
from tests.master_server.fakes import MS, START_NS, FakeUnit, S, joined, master, sees_all


def samples(metrics: Metrics) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Every series by its name and labels."""
    families = text_string_to_metric_families(metrics.exposition().decode())
    found = [
        (sample.name, frozenset(sample.labels.items()), sample.value) for one in families for sample in one.samples
    ]
    assert len({(name, labels) for name, labels, _ in found}) == len(found)
    return {(name, labels): value for name, labels, value in found}


def test_all_series_of_a_unit() -> None:
    one = master(with_robot=True)
    metrics = Metrics(one, Stream(one), Limits())
    unit = joined(one, 1, monotonic_ns())
    unit.update(monotonic_ns(), [1, 2, 3], seen=sees_all(one), age_ns=40 * MS)
    metrics.accepted(unit.initialized.id, 100, 300 * NS_PER_US)
    unit.update(monotonic_ns(), [1, 2, 3], age_ns=20 * MS)
    metrics.accepted(unit.initialized.id, 50, 100 * NS_PER_US)
    found = samples(metrics)
    of_unit = {("unit", "1"), ("ip", "10.0.0.1")}

    def value(name: str, *labels: tuple[str, str]) -> float:
        return found[f"cellwatch_{name}", frozenset(labels)]

    assert value("unit_updates_total", *of_unit) == 2
    assert value("unit_received_bytes_total", *of_unit) == 150
    assert value("unit_voxels", *of_unit) == 3
    assert value("unit_process_seconds", *of_unit) == pytest.approx(0.005)
    assert value("unit_fps", *of_unit) > 0.0
    assert 0.02 <= value("unit_age_seconds", *of_unit) < 1.0
    assert 0.0 <= value("unit_arrival_age_seconds", *of_unit) < 1.0
    states = {state: value("unit_state", *of_unit, ("state", state)) for state in ("live", "stale", "blind", "moved")}
    assert states == {"live": 1.0, "stale": 0.0, "blind": 0.0, "moved": 0.0}
    assert value("unit_info", *of_unit, ("serial", "S1"), ("model", "fake"), ("software", "")) == 1.0
    assert value("update_seconds_bucket", ("le", "0.0001")) == 1
    assert value("update_seconds_bucket", ("le", "0.0005")) == 2
    assert value("update_seconds_count") == 2
    assert value("update_seconds_sum") == pytest.approx(0.0004)
    assert (value("map_voxels"), value("map_complete"), value("seen_share")) == (3, 0, 1)
    assert (value("units"), value("units_live"), value("stream_readers")) == (1, 1, 0)
    assert ("cellwatch_robot_age_seconds", frozenset()) not in found
    assert value("build_info", ("version", importlib.metadata.version("cellwatch"))) == 1
    one.put_joints(JointsRequest(positions=(0.0, 0.0)), monotonic_ns())
    found = samples(metrics)
    assert 0.0 <= value("robot_age_seconds") < 1.0
    assert value("map_complete") == 1


def test_series_of_a_deleted_unit_vanish() -> None:
    one = master()
    metrics = Metrics(one, Stream(one), Limits())
    gone, kept = joined(one, 1), joined(one, 2)
    metrics.accepted(gone.initialized.id, 1, 1)
    assert any(("unit", "1") in labels for _, labels in samples(metrics))
    one.forget(gone.initialized.id)
    left = {dict(labels)["unit"] for _, labels in samples(metrics) if "unit" in dict(labels)}
    assert left == {str(kept.initialized.id)}


def test_names_reported_by_a_unit_are_escaped() -> None:
    one = master()
    FakeUnit(one, serial='a"} 7\\').initialize()
    assert any(("serial", 'a"} 7\\') in labels for _, labels in samples(Metrics(one, Stream(one), Limits())))


def test_refusals_by_status() -> None:
    one = master()
    metrics = Metrics(one, Stream(one), Limits())
    for status in (409, 401, 409):
        metrics.refused(status)
    refused = {dict(labels)["status"]: count for (name, labels), count in samples(metrics).items() if "refused" in name}
    assert refused == {"401": 1.0, "409": 2.0}


def test_refused_and_open_connections() -> None:
    one, limits = master(), Limits()
    metrics = Metrics(one, Stream(one), limits)
    for _ in range(REQUESTS_BURST + 3):
        with suppress(Refusal):
            limits.admit("10.0.0.1", START_NS)
    for _ in range(CONNECTIONS_PER_ADDRESS + 2):
        limits.connect("10.0.0.1", START_NS)
    found = samples(metrics)
    assert {dict(labels)["what"]: count for (name, labels), count in found.items() if "turned_away_total" in name} == {
        "request": 3.0,
        "token": 0.0,
        "connection": 2.0,
    }
    assert found["cellwatch_connections", frozenset()] == CONNECTIONS_PER_ADDRESS


def test_counting_and_a_scrape_of_all_units_are_cheap() -> None:
    one = master()
    metrics = Metrics(one, Stream(one), Limits())
    for number in range(MAX_UNITS):
        joined(one, number, monotonic_ns()).update(monotonic_ns(), [number], seen=sees_all(one))
    rounds, began_ns = 10_000, monotonic_ns()
    for _ in range(rounds):
        metrics.accepted(1, 1000, 300_000)
    assert (monotonic_ns() - began_ns) / rounds < 10 * NS_PER_US
    began_ns = monotonic_ns()
    metrics.exposition()
    # A scrape delays the updates of all units, once in some seconds.
    assert monotonic_ns() - began_ns < S // 10
