# SPDX-License-Identifier: Apache-2.0
"""Status messages of a later minor: readers keep codes that they do not know, and refuse them in requests."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from shared.messages import MAX_TEXT, CommandRow, Health, Reason, RobotAnswer, UnitRow, UpdateRequest

ROW: dict[str, Any] = {
    "id": 1,
    "ip": "10.0.0.1",
    "serial": "A",
    "model": "D435I",
    "software": "edge-unit 9",
    "state": "live",
    "reason": "",
    "age_s": 0.1,
    "arrival_age_s": 0.1,
    "clock_uncertainty_ms": 0.1,
    "fps": 15.0,
    "voxels": 0,
    "process_ms": 1.0,
    "frame_number": 1,
    "health": {},
    "T_world_camera": None,
    "versions": {},
    "updates": 1,
    "received_bytes": 1,
}
LATER_HEALTH = {
    "valid_share": 0.5,
    "trouble": "the lens is fogged",
    "trouble_code": "fogged",
    "progress": {"task": "defogging", "done": 1, "total": 9, "eta_s": 3.0},
    "humidity": 0.9,
}


def row(**changes: Any) -> UnitRow:
    needed = {name for name, field in UnitRow.model_fields.items() if field.is_required()}
    return UnitRow.model_validate({name: ROW.get(name, 0) for name in needed} | changes)


def test_a_unit_row_of_a_later_minor_is_read() -> None:
    read = row(
        state="dozing",
        phase="defrosting",
        cause={"code": "fogged", "sentence": "the lens is fogged", "numbers": {"humidity": 0.9}, "since_s": 3.0},
        health=LATER_HEALTH,
        pose_origin="gps",
        pose_quality={"uncertainty_mm": 1.0, "uncertainty_of_it": 2.0},
        mood="good",
    )
    assert read.state == "dozing"
    assert read.cause is not None
    assert (read.cause.code, read.cause.numbers) == ("fogged", {"humidity": 0.9})
    assert (read.health.trouble_code, read.health.valid_share) == ("fogged", 0.5)
    assert read.health.progress is not None
    assert (read.health.progress.task, read.health.progress.total) == ("defogging", 9)
    assert (read.phase, read.pose_origin, read.pose_quality.uncertainty_mm) == ("defrosting", "gps", 1.0)
    again = UnitRow.model_validate_json(read.model_dump_json())
    assert (again.state, again.health.trouble_code) == ("dozing", "fogged")


def test_a_row_of_this_minor_is_equal_after_it_was_read() -> None:
    written = row(health=Health(trouble="x", trouble_code="camera").model_dump())
    assert UnitRow.model_validate_json(written.model_dump_json()) == written


def test_an_unknown_code_is_bounded_text() -> None:
    for code in ("x" * (MAX_TEXT + 1), 3, None):
        with pytest.raises(ValidationError):
            row(state=code)
    with pytest.raises(ValidationError):
        CommandRow.model_validate({"id": 1, "verb": "sing", "outcome": None, "code": ["done"]})


def test_outcomes_and_reasons_of_a_later_minor_are_kept() -> None:
    read = CommandRow.model_validate({"id": 1, "verb": "sing", "outcome": "hoarse", "code": "hoarse", "key": "C"})
    assert (read.verb, read.code) == ("sing", "hoarse")
    assert Reason("later", "a reason of a later minor").code == "later"  # type: ignore[arg-type]  # as it is read


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"trouble_code": "fogged"}, "trouble_code"),
        ({"humidity": 0.9}, "humidity"),
        ({"progress": {"task": "defogging", "done": 1, "total": 9}}, "task"),
    ],
)
def test_a_request_with_an_unknown_code_is_refused_by_its_field(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(ValidationError) as caught:
        UpdateRequest.model_validate({"id": 1, "session": 1, "sequence": 1, "sent_at_ns": 1, "health": changes})
    assert any(field in error["loc"] for error in caught.value.errors())


def test_a_unit_refuses_joints_that_it_does_not_know() -> None:
    with pytest.raises(ValidationError):
        RobotAnswer.model_validate({"state": "inconsistent", "joint_names": (), "samples": (), "now_ns": 1})
