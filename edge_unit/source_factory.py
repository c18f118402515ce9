# SPDX-License-Identifier: Apache-2.0
"""Makes the configured source, by the factory registered for its kind."""

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
"""Factories by type of configuration."""

FACTORIES: SourceFactories = MappingProxyType(
    {
        RealsenseSourceConfig: RealsenseSource,
        RecordedSourceConfig: RecordedSource,
        SimulatedSourceConfig: SimulatedSource,
    }
)
"""The product's own factories. To put other hardware behind the same configuration, pass factories of your own."""


def make_source(config: SourceConfig, factories: SourceFactories = FACTORIES) -> DepthSource:
    """Make the configured source.

    Raises:
        ConfigError: no factory is registered for its kind.
    """
    factory = factories.get(type(config))
    if factory is None:
        known = ", ".join(sorted(each.model_fields["kind"].default for each in factories))
        raise ConfigError(f"source.kind: expected one of {known}, got {config.kind}")
    return factory(config)


def is_recording(config: SourceConfig) -> bool:
    """Return True for a source that does not recover by itself: a file stays as it is."""
    if isinstance(config, RealsenseSourceConfig):
        return config.recording is not None
    return isinstance(config, RecordedSourceConfig)
