# SPDX-License-Identifier: Apache-2.0
"""Readers of status and the unknown codes of a later minor."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from master_server.api.responses import StreamMessage, map_fields
from master_server.recording.moment import StateRecord, moment_of
from master_server.viewer.panel import table_html
from master_server.viewer.scene import STATE_COLOURS, state_colour
from shared.messages import MAX_TEXT, Reason, UnitRow
from tests.master_server.fakes import START_NS, S, joined, master

NOW_NS = START_NS + S
LATER: dict[str, Any] = {"code": "later_code", "sentence": "of a later minor", "numbers": {"x_m": 1.0}, "new": 1}


def _row() -> dict[str, Any]:
    one = master()
    joined(one)
    fields: dict[str, Any] = one.units(NOW_NS)[0].model_dump(mode="json")
    command = {"id": 1, "verb": "refine", "outcome": "later_outcome", "code": "later_outcome", "detail": "", "new": 1}
    return {**fields, "state": "later_state", "cause": LATER, "last_command": command, "new": 1}


def test_a_stream_message_with_unknown_codes_is_read() -> None:
    one = master()
    unit = {"id": 1, "ip": "10.0.0.1", "state": "later_state", "reason": "", "cause": LATER, "age_s": None, "voxels": 0}
    fields = {**map_fields(one.view(NOW_NS), "keys", None, NOW_NS), "number": 1, "units": [unit], "new": 1}
    fields |= {"voxels": [], "witnesses": [], "causes": [LATER], "complete": False}
    read = StreamMessage.model_validate(fields)
    assert (read.complete, read.causes[0].code, read.units[0].state) == (False, "later_code", "later_state")


def test_a_unit_row_with_unknown_codes_is_read_and_written_again() -> None:
    row = UnitRow.model_validate(_row())
    assert row.cause is not None
    assert row.last_command is not None
    assert (row.state, row.cause.code, row.last_command.code) == ("later_state", "later_code", "later_outcome")
    assert UnitRow.model_validate_json(row.model_dump_json()) == row


def test_a_recorded_state_with_unknown_codes_is_read() -> None:
    one = master()
    fields = StateRecord.of(moment_of(one, NOW_NS)).model_dump(mode="json")
    read = StateRecord.model_validate({**fields, "complete": False, "causes": [LATER], "units": [_row()]})
    assert (read.complete, read.causes[0].code, read.units[0].state) == (False, "later_code", "later_state")


def test_the_viewer_shows_an_unknown_state_and_not_as_live() -> None:
    assert "later_state" in table_html([UnitRow.model_validate(_row())])
    assert state_colour("later_state") != STATE_COLOURS["live"]


@pytest.mark.parametrize("code", [1, None, ["done"], "x" * (MAX_TEXT + 1)])
def test_a_code_is_a_bounded_string(code: object) -> None:
    with pytest.raises(ValidationError):
        TypeAdapter(Reason).validate_python({"code": code, "sentence": ""})
