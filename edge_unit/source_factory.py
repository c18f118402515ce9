# SPDX-License-Identifier: Apache-2.0
"""The source that the configuration chose."""

from __future__ import annotations

from edge_unit.config import SourceConfig
from edge_unit.sources.frame import DepthSource
from edge_unit.sources.realsense.source import RealsenseSource, RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from edge_unit.sources.simulated import SimulatedSource


def make_source(config: SourceConfig) -> DepthSource:
    """The source that the configuration chose."""
    if isinstance(config, RealsenseSourceConfig):
        return RealsenseSource(config)
    if isinstance(config, RecordedSourceConfig):
        return RecordedSource(config)
    return SimulatedSource(config)


def is_recording(config: SourceConfig) -> bool:
    """Whether it will not get better by itself: a file stays as it is."""
    if isinstance(config, RealsenseSourceConfig):
        return config.recording is not None
    return isinstance(config, RecordedSourceConfig)
