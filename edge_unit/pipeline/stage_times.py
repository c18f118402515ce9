# SPDX-License-Identifier: Apache-2.0
"""How long a frame spends in each stage of the method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

from shared.clock import stage_ns

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


@dataclass(frozen=True)
class StageTimes:
    """Nanoseconds that a frame spent in each stage; foreground and voxels are one sweep over the picture."""

    expected_ns: int = 0
    foreground_ns: int = 0
    density_ns: int = 0
    seen_ns: int = 0
    health_ns: int = 0
    misfit_ns: int = 0

    @property
    def total_ns(self) -> int:
        """All stages together."""
        return sum(vars(self).values())


class StageRunner:
    """Runs the stages of one frame and notes how long each took."""

    def __init__(self) -> None:
        self._took_ns: dict[str, int] = {}

    def run(
        self,
        stage: str,
        function: Callable[Arguments, Result],
        *arguments: Arguments.args,
        **named: Arguments.kwargs,
    ) -> Result:
        """Return what `function` returns; `stage` is a name of `StageTimes`, without the unit."""
        started_ns = stage_ns()
        result = function(*arguments, **named)
        self._took_ns[f"{stage}_ns"] = stage_ns() - started_ns
        return result

    def times(self) -> StageTimes:
        """Return what was noted; stages that did not run took nothing."""
        return StageTimes(**self._took_ns)
