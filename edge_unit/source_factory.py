# SPDX-License-Identifier: Apache-2.0
"""The source that the configuration names, made by what is registered for its kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from edge_unit.config import SourceConfig
from edge_unit.sources.frame import DepthSource
from edge_unit.sources.realsense.source import RealsenseSource, RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSource, RecordedSourceConfig
from edge_unit.sources.simulated import SimulatedSource, SimulatedSourceConfig
from shared.errors import ConfigError

SourceFactories = Mapping[type[SourceConfig], Callable[[Any], DepthSource]]
"""What makes the source of each type of configuration."""

FACTORIES: SourceFactories = MappingProxyType(
    {
        RealsenseSourceConfig: RealsenseSource,
        RecordedSourceConfig: RecordedSource,
        SimulatedSourceConfig: SimulatedSource,
    }
)
"""Those of the product. Whoever puts other hardware behind the same configuration hands over factories of its own."""


def make_source(config: SourceConfig, factories: SourceFactories = FACTORIES) -> DepthSource:
    """Make the source that the configuration names.

    Raises:
        ConfigError: nothing is registered for its kind.
    """
    factory = factories.get(type(config))
    if factory is None:
        known = ", ".join(sorted(each.model_fields["kind"].default for each in factories))
        raise ConfigError(f"source.kind: expected one of {known}, got {config.kind}")
    return factory(config)


def is_recording(config: SourceConfig) -> bool:
    """Return True for a source that will not get better by itself: a file stays as it is."""
    if isinstance(config, RealsenseSourceConfig):
        return config.recording is not None
    return isinstance(config, RecordedSourceConfig)
