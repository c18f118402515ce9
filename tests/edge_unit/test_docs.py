# SPDX-License-Identifier: Apache-2.0
"""docs/unit.md names every key that a unit or a master can be configured with."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel

from edge_unit.config import UnitConfig
from edge_unit.sources.realsense.source import RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSourceConfig
from edge_unit.sources.simulated import SimulatedSourceConfig
from master_server.config import MasterConfig

PAGE = (Path(__file__).parents[2] / "docs" / "unit.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("model", "heading"),
    [
        (UnitConfig, "# A unit's configuration"),
        (RealsenseSourceConfig, "## `source: {kind: realsense}`"),
        (RecordedSourceConfig, "## `source: {kind: recorded}`"),
        (SimulatedSourceConfig, "## `source: {kind: simulated}`"),
        (MasterConfig, "## The master"),
    ],
)
def test_every_key_is_explained(model: type[BaseModel], heading: str) -> None:
    section = PAGE[PAGE.index(heading) :].removeprefix("#").split("\n## ")[0]
    missing = [name for name in model.model_fields if name != "kind" and f"`{name}`" not in section]
    assert not missing
