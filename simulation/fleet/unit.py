# SPDX-License-Identifier: Apache-2.0
"""`python -m simulation.fleet.unit CONFIG.YAML`: the edge unit with a simulated camera that is evaluated.

All but the source is the installed daemon, and its configuration knows nothing of the evaluation. The options of this
command add a file with the truth of each frame, and a file by which hands reach the camera. All other arguments go to
`edge-unit run`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from pydantic import ValidationError

from edge_unit.__main__ import main as run_edge_unit
from edge_unit.sources.frame import DepthSource
from edge_unit.sources.simulated import SimulatedSource, SimulatedSourceConfig
from shared.configuration import sentence
from shared.settings import FilterSettings
from simulation.fleet.truth_file import TruthWriter
from simulation.world.handling import Hands

MODULE = "simulation.fleet.unit"
"""For `python -m`."""

VOXEL_SIZE_M: float = FilterSettings().voxel_size_m
"""Default voxel size of the truth: that of a master whose settings nobody changed."""


def arguments_of(truth: Path | None, voxel_size_m: float, handling: Path | None) -> tuple[str, ...]:
    """Return the options of this command for a child process."""
    options: list[str] = []
    if truth is not None:
        options += ("--truth", str(truth), "--truth-voxel-size-m", str(voxel_size_m))
    if handling is not None:
        options += ("--handling", str(handling))
    return tuple(options)


def evaluated_source(
    truth: Path | None, voxel_size_m: float, handling: Path | None
) -> Callable[[SimulatedSourceConfig], DepthSource]:
    """Return a factory of simulated sources with a truth file and hands; None leaves the one or the other out."""

    def make(config: SimulatedSourceConfig) -> DepthSource:
        observer = None if truth is None else TruthWriter(truth, voxel_size_m)
        return SimulatedSource(config, Hands(handling), observer)

    return make


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the unit until it is stopped."""
    options, others = _parser().parse_known_args(arguments)
    source = evaluated_source(options.truth, options.truth_voxel_size_m, options.handling)
    return run_edge_unit(["run", *others], {SimulatedSourceConfig: source})


def _parser() -> argparse.ArgumentParser:
    # Without abbreviations: all that is not spelled out here belongs to `edge-unit run`.
    parser = argparse.ArgumentParser(
        prog=f"python -m {MODULE}",
        description="The edge unit with a simulated camera that is evaluated; other arguments as for `edge-unit run`.",
        allow_abbrev=False,
    )
    parser.add_argument("--truth", type=Path, metavar="FILE", help="append the truth of each frame to this file")
    parser.add_argument(
        "--truth-voxel-size-m",
        type=_voxel_size_m,
        default=VOXEL_SIZE_M,
        metavar="M",
        help=f"voxel size of the truth, as in the master's settings (default {VOXEL_SIZE_M:g})",
    )
    parser.add_argument(
        "--handling",
        type=Path,
        metavar="FILE",
        help="JSON file of what is done to the camera now: `xyz` m, `rpy_deg`, `covered`, `serial`",
    )
    return parser


def _voxel_size_m(text: str) -> float:
    # The bounds are those of the setting itself.
    try:
        return FilterSettings.model_validate({"voxel_size_m": text}).voxel_size_m
    except ValidationError as error:
        raise argparse.ArgumentTypeError(sentence(error)) from error


if __name__ == "__main__":
    sys.exit(main())
