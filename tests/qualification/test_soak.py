# SPDX-License-Identifier: Apache-2.0
"""Faults are drawn as they should be, growth and wrong answers are seen, and a short soak is survived."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import pytest

from qualification.fault_site.scene import NEWCOMER, RESIDENTS
from qualification.fault_site.watch import Answer
from qualification.soak_site import site
from qualification.soak_site.schedule import HOLD_S, schedule
from qualification.soak_site.site import GRACE_NS, KINDS, Scene
from qualification.soak_site.usage import CALM_LOOKS, Lifetime, Sample
from shared.clock import NS_PER_S

FIRST, SECOND = (thing.name for thing in RESIDENTS)


def test_the_same_seed_draws_the_same_faults_and_no_target_is_struck_twice_at_once() -> None:
    found = schedule(KINDS, "7", 600.0, early=True)
    assert found == schedule(KINDS, "7", 600.0, early=True)
    assert found != schedule(KINDS, "8", 600.0, early=True)
    assert {strike.name for strike in found} == set(KINDS)
    by_target = defaultdict(list)
    for strike in found:
        assert HOLD_S[0] <= strike.hold_s <= HOLD_S[1]
        assert strike.at_s + strike.hold_s <= 600.0
        by_target[KINDS[strike.name].target].append(strike)
    for strikes in by_target.values():
        for one, following in pairwise(strikes):
            assert one.at_s + one.hold_s <= following.at_s + 0.002


def test_long_lived_processes_end_only_in_early_rounds() -> None:
    late = {strike.name for strike in schedule(KINDS, "7", 600.0, early=False)}
    assert late == {name for name, kind in KINDS.items() if not kind.early}
    assert "master killed" not in late


def lifetime(rss_mib: list[float], handles: list[int]) -> Lifetime:
    samples = [Sample(float(n), rss, 3, 10) for n, rss in enumerate(rss_mib)]
    calm = [Sample(len(rss_mib) + 0.1 * n, rss_mib[-1], 3, count, calm=True) for n, count in enumerate(handles)]
    return Lifetime("process", 1, samples + calm)


@pytest.mark.parametrize(
    ("rss_mib", "grew"),
    [
        ([50.0] * 100 + [100.0] * 300, False),
        ([100.0] * 300 + [108.0] * 100, True),
        ([100.0] * 300 + [106.0] * 100, False),
    ],
)
def test_memory_grew_when_the_last_quarter_takes_more_than_the_second(rss_mib: list[float], grew: bool) -> None:
    assert lifetime(rss_mib, []).memory_grew is grew


@pytest.mark.parametrize(
    ("handles", "grown"),
    [
        ([], 0),
        ([10] * CALM_LOOKS, 0),
        ([10, 11, 10, 12, 13, 12], 1),
        ([10, 12, 10, 11, 11, 11, 9, 15, 15], 0),
        ([10, 10, 10, 12, 12, 12, 14, 14, 14, 16, 17, 16], 4),
    ],
)
def test_handles_are_counted_at_calm_moments(handles: list[int], grown: int) -> None:
    assert lifetime([1.0], handles).handles_grown == grown


def answer(now_ns: int, complete: bool, held: set[str], free: tuple[str, ...] = ()) -> Answer:
    return Answer(now_ns, now_ns, complete, (), 2, 0.1, frozenset(held), frozenset(free))


def test_answers_are_compared_with_the_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, both = Scene(), {FIRST, SECOND}
    came_ns = 100 * NS_PER_S
    monkeypatch.setattr(site, "monotonic_ns", lambda: came_ns)
    scene.change((*both, NEWCOMER.name))
    before_ns, soon_ns, later_ns = came_ns - 1, came_ns + GRACE_NS // 2, came_ns + 2 * GRACE_NS
    # Nobody can know at once that somebody came.
    assert not scene.wrong(answer(soon_ns, True, both, (NEWCOMER.name,)))
    assert not scene.wrong(answer(soon_ns, True, both | {NEWCOMER.name}))
    assert not scene.wrong(answer(later_ns, True, both | {NEWCOMER.name}))
    assert not scene.wrong(Answer(later_ns))
    assert "complete without the newcomer" in scene.wrong(answer(later_ns, True, both))
    assert "free although there is the newcomer" in scene.wrong(answer(later_ns, False, both, (NEWCOMER.name,)))
    assert "which is not there" in scene.wrong(answer(before_ns, True, both | {NEWCOMER.name}))
    assert not scene.wrong(answer(later_ns, False, set()))
    goes_ns = came_ns + 10 * NS_PER_S
    monkeypatch.setattr(site, "monotonic_ns", lambda: goes_ns)
    scene.change(both, (NEWCOMER.name,))
    assert not scene.wrong(answer(goes_ns + 2 * GRACE_NS, True, both))
    assert not scene.wrong(answer(goes_ns + 2 * GRACE_NS, True, both | {NEWCOMER.name}))


@pytest.mark.slow
@pytest.mark.alone
def test_a_short_soak_is_survived(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "qualification.soak", "--seconds", "16", "--seed", "1", "--results", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500.0, check=False)
    assert done.stdout, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["seed"] == 1
    assert found["faults_count"] > 3
    assert found["answers_judged"] > 100
    assert len(found["calms"]["rows"]) == 2
    assert found["passed"], found["calms"]["marks"] + found["processes"]["marks"]
    assert json.loads((tmp_path / "soak.json").read_text())["faults"] == found["faults"]
