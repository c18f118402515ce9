# SPDX-License-Identifier: Apache-2.0
"""Assignment of times to stages, and one case from end to end."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.latency import STAGES, TO_MERGED, WHOLE, Case, main, result, timed
from benchmarks.latency_probe.frames import RING_HZ, camera_phase_s, prepare
from benchmarks.latency_probe.unit import RingSource
from benchmarks.load_generator.map_readers import ASKING, LISTENING, Reading
from edge_unit.monitoring import TraceRecord
from edge_unit.sources.simulated import SimulatedSourceConfig
from shared.clock import NS_PER_MS, NS_PER_S, monotonic_ns

MS = NS_PER_MS

INSTANT = {"seen": 0, "health": 0}
UNIT_STAGES = ("source", "joints", "thread", "robot", "filter", "density", "check", "report")


def record(number: int, captured_ms: int, sent: bool = True) -> TraceRecord:
    """Return a record in which each stage at the unit takes 1 ms, two nothing, the queue 2, the transfer 3, the merge
    4: 17 in all.
    """
    at_ns = captured_ms * MS
    return TraceRecord(
        number, at_ns, 1.5, b"", (4, 5, 6), 0.05, sent,
        at_ns + 17 * MS if sent else None, at_ns + 10 * MS, at_ns + 13 * MS, dict.fromkeys(UNIT_STAGES, MS) | INSTANT,
    )  # fmt: skip


def reading(made_ms: int) -> Reading:
    return Reading(made_ms * MS, made_ms * MS, (made_ms + 5) * MS, (made_ms + 6) * MS, 100, 3, True, 0.02)


def test_stages_and_the_first_map_that_has_the_frame() -> None:
    case = Case((424, 240), 30.0)
    records = [record(0, 100), record(1, 133), record(2, 166, sent=False), record(3, 900)]
    maps = {LISTENING: [reading(116), reading(119), reading(152)], ASKING: [reading(160)]}
    found = timed(case, records, maps)
    assert (found.frames, found.dropped) == (3, 1)
    assert [found.ms[name].tolist() for name in ("robot", "queue", "transfer", "merge", TO_MERGED)] == [
        [1.0] * 3, [2.0] * 3, [3.0] * 3, [4.0] * 3, [17.0] * 3,
    ]  # fmt: skip
    # The map of 116 does not hold the first frame, which is merged at 117. No reader received the last frame.
    assert found.ms[WHOLE[LISTENING]].tolist() == [25.0, 25.0]
    assert found.ms[f"{LISTENING}: until the next message is made"].tolist() == [2.0, 2.0]
    assert found.ms[WHOLE[ASKING]].tolist() == [66.0, 33.0]
    told = result([found])
    assert [row[1] for row in told.rows[: len(STAGES)]] == [1.0] * 6 + [0.0, 0.0, 1.0, 1.0] + [2.0, 3.0, 4.0]
    assert told.marks[0].met


def test_cameras_play_their_rings_at_the_moments_of_their_frames(tmp_path: Path) -> None:
    ring = tmp_path / "ring.npy"
    prepare(ring, 1, 4, (424, 240), frames=6)
    frames = np.load(ring)
    assert frames.shape == (6, 240, 424)
    epoch_ns = monotonic_ns() - NS_PER_S
    config = SimulatedSourceConfig(camera=1, fps=15.0, epoch_ns=epoch_ns)

    async def play() -> None:
        source = RingSource(config, ring)
        assert (await source.open()).T_world_camera is not None
        last = -1
        count = 0
        async for frame in source.frames():
            since_ns = frame.captured_at_ns - epoch_ns - round(camera_phase_s(1, 4) * NS_PER_S)
            assert since_ns == frame.frame_number * round(NS_PER_S / 15.0)
            assert frame.frame_number > last
            # Every second frame of the ring, which has 30 a second.
            place = round(since_ns / NS_PER_S * RING_HZ) % 6
            assert np.array_equal(frame.depth, frames[place])
            last, count = frame.frame_number, count + 1
            if count == 3:
                break
        await source.close()

    asyncio.run(play())


@pytest.mark.slow
def test_one_case_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--sizes", "424x240", "--rates", "15", "--seconds", "2", "--frames", "30", "--results", str(tmp_path)]
    main(arguments)
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    (case,) = found["cases"].values()
    assert case["frames"] > 10
    assert case[WHOLE[LISTENING]]["p50_ms"] > case[TO_MERGED]["p50_ms"] > case["robot"]["p50_ms"] > 0.0
    assert json.loads((tmp_path / "latency.json").read_text())["cases"] == found["cases"]
