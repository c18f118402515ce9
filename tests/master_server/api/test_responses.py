# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import msgpack
import numpy as np
import pytest

from master_server.api.responses import (
    CoverageAnswer,
    Form,
    StreamMessage,
    as_json,
    as_msgpack,
    coverage_fields,
    coverage_shares,
    map_fields,
    unseen_fields,
)
from master_server.core import MapView
from shared.clock import stage_ns
from shared.lattice import Lattice
from shared.messages import VoxelsAnswer
from shared.wire import pack_seen
from tests.master_server.fakes import MS, START_NS, S, joined, master, sees_all

NOW_NS = START_NS + S
NOBODY = np.zeros((10, 10, 10), np.uint8)


def test_shares_count_the_blocks_that_live_units_see() -> None:
    seen_by = np.array([[[0, 1, 2], [3, 4, 255]]], np.uint8)
    assert coverage_shares(seen_by) == pytest.approx([1 / 6, 1 / 6, 1 / 6, 3 / 6])
    assert coverage_shares(np.zeros((2, 2, 2), np.uint8)) == [1.0, 0.0, 0.0, 0.0]


def test_blocks_come_as_runs() -> None:
    one = master()
    grid = np.random.default_rng(1).random((10, 20, 5)) < 0.5
    joined(one, 1).update(NOW_NS, seen=pack_seen(grid, 0.1))
    joined(one, 2).update(NOW_NS, seen=sees_all(one))
    found = CoverageAnswer.model_validate(coverage_fields(one, True, NOW_NS))
    assert found.blocks is not None
    assert np.array_equal(np.repeat(found.blocks.counts, found.blocks.runs).reshape(found.blocks.shape), 1 + grid)
    assert found.shares == pytest.approx([0.0, 1.0 - grid.mean(), grid.mean(), 0.0])


def test_a_silent_unit_covers_nothing() -> None:
    one = master()
    joined(one).update(NOW_NS, seen=sees_all(one))
    assert coverage_fields(one, False, NOW_NS)["seen_share"] == 1.0
    later = coverage_fields(one, True, NOW_NS + 2 * S)
    assert (later["seen_share"], later["units_live"], later["complete"]) == (0.0, 0, False)
    assert (later["blocks"]["counts"], later["blocks"]["runs"]) == ([0], [1000])


def test_json_and_msgpack_are_equivalent() -> None:
    one = master()
    joined(one).update(NOW_NS, [0, 411])
    fields = map_fields(one.view(NOW_NS), "centres", None, NOW_NS)
    fields |= {"number": 1, "units": one.unit_states(NOW_NS)}
    assert json.loads(as_json(fields)) == msgpack.unpackb(as_msgpack(fields))
    message = StreamMessage.model_validate_json(as_json(fields))
    assert message.voxels == [[0.025, 0.025, 0.025], [0.075, 0.075, 0.075]]
    assert (message.units[0].voxels, message.units[0].state) == (2, "live")


@pytest.mark.parametrize("form", ["indices", "centres", "keys"])
@pytest.mark.parametrize("count", [0, 1, 15_000])
def test_voxels_are_encoded_fast_enough_for_updates(form: Form, count: int) -> None:
    lattice = Lattice((-1.0, 0.0, 0.5), 0.02, (150, 150, 150))
    keys = np.sort(np.random.default_rng(1).choice(lattice.cell_count, count, replace=False)).astype(np.uint32)
    # As from a recording: not contiguous in memory.
    witnesses = np.arange(2 * count, dtype=np.uint8)[::2]
    view = MapView(lattice, 1, keys, witnesses, (), None, 1)
    indices = lattice.indices(keys)
    expected = {"indices": indices, "centres": np.round(lattice.centres(indices), 4), "keys": keys}[form].tolist()
    took_ns = []
    for _ in range(5):
        began_ns = stage_ns()
        fields = map_fields(view, form, unseen_fields(Lattice((0.0, 0.0, 0.0), 0.1, (10, 10, 10)), NOBODY), NOW_NS)
        written, packed = as_json(fields), as_msgpack(fields)
        took_ns.append(stage_ns() - began_ns)
    assert json.loads(written) == msgpack.unpackb(packed)
    found = VoxelsAnswer.model_validate_json(written)
    assert (found.voxels, found.witnesses) == (expected, witnesses.tolist())
    assert found.unseen is not None
    assert len(found.unseen["blocks"]) == 1000
    assert min(took_ns) < 10 * MS
