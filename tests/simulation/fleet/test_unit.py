# SPDX-License-Identifier: Apache-2.0
"""The entry point of evaluated units: its own options stay here, all others go to `edge-unit run`."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from edge_unit.sources.frame import DepthSource
from edge_unit.sources.simulated import SimulatedSource, SimulatedSourceConfig
from simulation.fleet import unit
from simulation.world.handling import Handling

WAIT_S = 20.0
"""Kernels may have to be compiled first."""

Factories = Mapping[type[Any], Callable[[Any], DepthSource]]


class Ran:
    """Stands for `edge-unit`, and keeps what it is started with."""

    def __init__(self) -> None:
        self.arguments: list[str] = []
        self.factories: Factories = {}

    def __call__(self, arguments: Sequence[str], factories: Factories) -> int:
        self.arguments, self.factories = list(arguments), factories
        return 3


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> Ran:
    ran = Ran()
    monkeypatch.setattr(unit, "run_edge_unit", ran)
    return ran


async def test_options_reach_the_source_and_no_other_part_of_the_unit(ran: Ran, tmp_path: Path) -> None:
    truth, handling = tmp_path / "truth", tmp_path / "handling.json"
    Handling(serial="ANOTHER").write(handling)
    own = unit.arguments_of(truth, 0.03, handling)
    assert unit.main(["unit.yaml", *own, "--set", "a=b", "--log-level", "WARNING"]) == 3
    assert ran.arguments == ["run", "unit.yaml", "--set", "a=b", "--log-level", "WARNING"]
    assert list(ran.factories) == [SimulatedSourceConfig]
    source = ran.factories[SimulatedSourceConfig](SimulatedSourceConfig(people=0))
    assert isinstance(source, SimulatedSource)
    try:
        assert (await asyncio.wait_for(source.open(), WAIT_S)).serial == "ANOTHER"
        assert truth.exists()
    finally:
        await source.close()


def test_without_options_nothing_is_added(ran: Ran) -> None:
    assert unit.arguments_of(None, 0.03, None) == ()
    assert unit.main(["unit.yaml"]) == 3
    assert ran.arguments == ["run", "unit.yaml"]


@pytest.mark.parametrize("value", ["3", "small", "nan"])
def test_a_voxel_size_that_no_master_has_is_refused(value: str, ran: Ran, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        unit.main(["unit.yaml", "--truth", "truth", "--truth-voxel-size-m", value])
    assert "voxel_size_m" in capsys.readouterr().err
    assert ran.arguments == []


def test_no_kernel_is_imported_before_their_folder_is_settled() -> None:
    check = f"import sys, {unit.MODULE}; print([name for name in sys.modules if name.startswith('geometry.kernels')])"
    found = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
