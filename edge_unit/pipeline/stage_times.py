# SPDX-License-Identifier: Apache-2.0
"""Time that a frame spends in each stage of the method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

from shared.clock import stage_ns

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


@dataclass(frozen=True)
class StageTimes:
    """Nanoseconds that a frame spent in each stage; foreground and voxels are one pass over the image."""

    expected_ns: int = 0
    foreground_ns: int = 0
    density_ns: int = 0
    seen_ns: int = 0
    health_ns: int = 0
    misfit_ns: int = 0

    @property
    def total_ns(self) -> int:
        """The sum of all stages."""
        return sum(vars(self).values())


class StageRunner:
    """Runs the stages of one frame and measures the time of each."""

    def __init__(self) -> None:
        self._took_ns: dict[str, int] = {}

    def run(
        self,
        stage: str,
        function: Callable[Arguments, Result],
        *arguments: Arguments.args,
        **named: Arguments.kwargs,
    ) -> Result:
        """Call `function` and return its result; `stage` is a name of `StageTimes`, without the unit."""
        started_ns = stage_ns()
        result = function(*arguments, **named)
        self._took_ns[f"{stage}_ns"] = stage_ns() - started_ns
        return result

    def times(self) -> StageTimes:
        """Return the times; a stage that did not run took 0."""
        return StageTimes(**self._took_ns)
