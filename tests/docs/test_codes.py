# SPDX-License-Identifier: Apache-2.0
"""The page of codes names every code of the contract, and no other."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, get_args

import pytest

from shared.messages import OutcomeCode, ReasonCode, State, Task, TroubleCode

PAGE = Path(__file__).resolve().parent.parent.parent / "docs" / "watching.md"
ROW = re.compile(r"^\| (`[a-z_]+`(?:, `[a-z_]+`)*) \|(.*)\|$", re.MULTILINE)


def part(heading: str) -> str:
    """Return the text between a bold heading and the next one."""
    text = PAGE.read_text(encoding="utf-8")
    begin = text.index(f"**{heading}.**")
    return text[begin : text.find("\n**", begin + 1)]


def codes_of(literal: Any) -> set[str]:
    """Return the strings of a Literal, also of one inside another."""
    return {text for part in get_args(literal) for text in ({part} if isinstance(part, str) else codes_of(part))}


@pytest.mark.parametrize(
    ("heading", "literal"), [("Reasons", ReasonCode), ("Troubles", TroubleCode), ("Outcomes", OutcomeCode)]
)
def test_every_code_has_a_row_and_every_row_a_code(heading: str, literal: Any) -> None:
    rows = [code for codes, _ in ROW.findall(part(heading)) for code in re.findall(r"`([a-z_]+)`", codes)]
    assert len(rows) == len(set(rows))
    assert set(rows) == codes_of(literal)


def test_every_task_is_named() -> None:
    assert codes_of(Task) <= set(re.findall(r"`([a-z_]+)`", part("Progress")))


def test_states_are_those_of_units() -> None:
    rows = ROW.findall(part("Reasons"))
    assert rows
    named = {word for _, rest in rows for word in re.findall(r"[a-z]+", rest.split("|")[0])}
    assert named - {"or", "the", "map"} <= set(codes_of(State))
