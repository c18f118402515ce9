# SPDX-License-Identifier: Apache-2.0
"""The source that the configuration selects."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_unit.config import SourceConfig
from edge_unit.source_factory import FACTORIES, is_recording, make_source
from edge_unit.sources.realsense.source import RealsenseSource, RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from edge_unit.sources.simulated import SimulatedSource, SimulatedSourceConfig
from shared.errors import ConfigError


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


def test_other_hardware_can_replace_a_source() -> None:
    made = RecordedSource(RecordedSourceConfig(folder=Path("images")))
    factories = {**FACTORIES, SimulatedSourceConfig: lambda _config: made}
    assert make_source(SimulatedSourceConfig(), factories) is made
    assert isinstance(make_source(RealsenseSourceConfig(), factories), RealsenseSource)


def test_a_kind_that_nothing_is_registered_for_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"source\.kind: expected one of recorded, got simulated"):
        make_source(SimulatedSourceConfig(), {RecordedSourceConfig: RecordedSource})
