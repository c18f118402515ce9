# SPDX-License-Identifier: Apache-2.0
"""The judge of the fault table condemns every wrong answer, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from qualification.fault_site.scene import BOX_MIN_M, NEWCOMER, RESIDENTS
from qualification.fault_site.watch import Answer, Present, Verdict, in_force, judge
from shared.clock import NS_PER_S

CAUSE_NS, GONE_NS = 10 * NS_PER_S, 13 * NS_PER_S
HERE = frozenset({RESIDENTS[0].name})
BOTH = HERE | {NEWCOMER.name}
THINGS = [Present(RESIDENTS[0], 0), Present(NEWCOMER, CAUSE_NS)]

GOOD = Answer(0, 0, complete=True, units_live=2, held=HERE, free=frozenset({NEWCOMER.name}))
STALE = Answer(0, 0, reasons=("unit 1 (127.0.0.2) is stale",), units_live=1)
BACK = Answer(0, 0, complete=True, units_live=2, held=BOTH)


def at(seconds: float, answer: Answer) -> Answer:
    now_ns = round(seconds * NS_PER_S)
    return replace(answer, got_ns=now_ns, now_ns=None if answer.now_ns is None else now_ns)


def verdict(*answers: Answer, names: str | None = "(127.0.0.2)", blind: bool = True) -> Verdict:
    return judge(answers, THINGS, CAUSE_NS, CAUSE_NS, GONE_NS, names, blind, 2)


COURSE = (
    at(9.9, GOOD),
    at(10.4, GOOD),
    at(10.6, STALE),
    at(12.9, STALE),
    at(13.1, STALE),
    at(13.3, BACK),
    at(14, BACK),
)


def test_a_fault_is_listed_with_its_times() -> None:
    found = verdict(*COURSE)
    assert found.noticed_s == pytest.approx(0.6)
    assert found.recovered_s == pytest.approx(0.3)
    assert found.false_free == ""
    assert found.told == "unit 1 (127.0.0.2) is stale"


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (at(11.0, GOOD), "free although it holds the newcomer"),
        (at(11.0, replace(STALE, free=HERE)), "free although it holds the resident of camera 1"),
        (at(11.0, replace(BACK, held=HERE)), "complete without the newcomer"),
        (at(11.0, replace(BACK, units_live=1)), "complete with 1 of 2 units"),
        (at(11.0, BACK), "complete although the fault hid the state"),
        (at(13.5, replace(BACK, held=frozenset(), free=frozenset())), "complete without the newcomer"),
    ],
)
def test_each_way_of_being_wrong_is_found(wrong: Answer, words: str) -> None:
    assert words in verdict(*COURSE, wrong).false_free


def test_a_reason_that_names_another_unit_notices_nothing() -> None:
    other = replace(STALE, reasons=("unit 2 (127.0.0.3) is stale",))
    assert verdict(at(10.6, other), at(13.1, BACK)).noticed_s is None


def test_a_missing_answer_reveals_a_dead_master_and_claims_nothing() -> None:
    silence: Any = Answer(round(10.1 * NS_PER_S))
    found = verdict(silence, at(13.2, BACK), names="")
    assert found.noticed_s == pytest.approx(0.1)
    assert found.false_free == ""


def test_a_map_that_falls_back_has_not_recovered_before() -> None:
    assert verdict(*COURSE, at(14.5, STALE)).recovered_s is None
    assert verdict(*COURSE, at(14.5, STALE), at(14.8, BACK)).recovered_s == pytest.approx(1.8)


def test_only_blocks_that_a_thing_crosses_wholly_count() -> None:
    blocks = NEWCOMER.blocks(np.array(BOX_MIN_M), 0.1)
    assert len(blocks) >= 4
    assert set(blocks[:, 1]) == {2}


def test_a_message_of_a_stream_counts_until_the_next() -> None:
    late = (at(9.9, GOOD), at(11.0, STALE), at(13.3, BACK))
    assert verdict(*late).false_free == ""
    assert "free although" in verdict(*in_force(late)).false_free
