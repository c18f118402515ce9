# SPDX-License-Identifier: Apache-2.0
"""The daemon with cameras that can be plugged in and out: SOCKETS CONFIG.YAML."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from edge_unit.config import UnitConfig
from edge_unit.daemon.unit import Unit
from edge_unit.sources.realsense.source import RealsenseSource, RealsenseSourceConfig
from shared.configuration import load
from simulation.cameras.pluggable import command

if __name__ == "__main__":
    sockets, path = map(Path, sys.argv[1:])
    config = load(UnitConfig, path, {}, "", {})
    assert isinstance(config.source, RealsenseSourceConfig)
    asyncio.run(Unit(config, RealsenseSource(config.source, command(sockets))).run())
