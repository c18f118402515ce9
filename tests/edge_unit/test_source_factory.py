# SPDX-License-Identifier: Apache-2.0
"""The source that the configuration chose."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_unit.config import SourceConfig
from edge_unit.source_factory import is_recording, make_source
from edge_unit.sources.realsense.source import RealsenseSource, RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from edge_unit.sources.simulated import SimulatedSource, SimulatedSourceConfig


@pytest.mark.parametrize(
    ("config", "kind", "recording"),
    [
        (RealsenseSourceConfig(), RealsenseSource, False),
        (RealsenseSourceConfig(recording=Path("one.db3")), RealsenseSource, True),
        (RecordedSourceConfig(folder=Path("images")), RecordedSource, True),
        (SimulatedSourceConfig(), SimulatedSource, False),
    ],
)
def test_the_configuration_chooses(config: SourceConfig, kind: type, recording: bool) -> None:
    assert isinstance(make_source(config), kind)
    assert is_recording(config) is recording
