# SPDX-License-Identifier: Apache-2.0
"""Curves that explain themselves, tables, and remarks on the figures in which our filter is worse."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.ground_truth.surface import Tally
from benchmarks.ground_truth.trials import Tallies
from benchmarks.reporting.report import Curves, Result, table

SHORT = {
    "recall_percent": "Found",
    "recall_strict_percent": "Found strictly",
    "lost_percent": "Lost",
    "false_per_1000": "False voxels",
    "tool_median_mm": "Median error at the tool",
    "tool_p99_mm": "99 % error at the tool",
}
"""Metrics that are drawn, with their titles. The file name of a plot begins with the title."""

CEILING = "any pixel"
"""An upper bound of what any filter can find. It is no filter by itself."""

EVERYTHING = "all things"
"""The sum over all things of an axis."""


@dataclass(frozen=True)
class Axis:
    """Quantity on the x axis of a curve."""

    key: str
    label: str
    unit: str
    metrics: tuple[str, ...]
    note: str


@dataclass(frozen=True)
class Metric:
    """Quantity on the y axis of a curve.

    `worse_by` is the smallest difference to a baseline that counts as worse. Its sign says which direction is bad.
    """

    key: str
    label: str
    unit: str
    of: Callable[[Tally], float]
    worse_by: float
    of_size: bool = False


@dataclass(frozen=True)
class Curve:
    """One plot. `series` holds the points (x, y) of each contender; y is NaN if there is no figure."""

    axis: Axis
    metric: Metric
    subject: str
    series: dict[str, list[tuple[float, float]]]
    frames: int

    @property
    def picture(self) -> Curves:
        """Return the curve for the page. A logarithmic axis does not draw 0."""
        is_false = self.metric.key == "false_per_1000"
        is_any = any(y > 0.0 for points in self.series.values() for _, y in points)
        return Curves(
            f"{SHORT[self.metric.key]} by {self.axis.key}, {self.subject}",
            f"{self.axis.label} ({self.axis.unit})",
            f"{self.metric.label} ({self.metric.unit})",
            self.series,
            "y" if is_false and is_any else "",
        )

    def document(self) -> dict[str, Any]:
        """Return plain values: for each contender one y per x, null if there is no figure."""
        at = sorted({x for points in self.series.values() for x, _ in points})
        return {
            "id": f"{self.axis.key}/{self.metric.key}/{self.subject}",
            "subject": self.subject,
            "x": {"key": self.axis.key, "label": self.axis.label, "unit": self.axis.unit, "values": at},
            "y": {"key": self.metric.key, "label": self.metric.label, "unit": self.metric.unit},
            "note": self.axis.note,
            "frames_per_point": self.frames,
            "contenders": {name: [_short(_at(self, name, x)) for x in at] for name in self.series},
        }


def _share(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else math.nan


def _quantile_mm(errors_m: list[float], share: float) -> float:
    """Return a quantile in mm. An infinite quantile is no figure: nothing was reported."""
    if not errors_m:
        return math.nan
    error_m = float(np.quantile(errors_m, share, method="inverted_cdf"))
    return 1e3 * error_m if math.isfinite(error_m) else math.nan


METRICS = {
    metric.key: metric
    for metric in (
        Metric(
            "recall_percent", "visible surface voxels found within a voxel", "%", lambda t: _share(t.found, t.visible),
            -1.0,
        ),
        Metric(
            "recall_strict_percent", "visible surface voxels found strictly", "%",
            lambda t: _share(t.found_strictly, t.visible), -1.0,
        ),
        Metric("lost_percent", "frames that lose the thing", "%", lambda t: _share(t.lost_frames, t.frames), 1.0),
        Metric("false_per_1000", "false voxels in 1,000 frames", "voxels", lambda t: 1e3 * t.false / t.frames, 1.0),
        Metric(
            "tool_median_mm", "error of the distance from the tool, median", "mm",
            lambda t: _quantile_mm(t.tool_errors_m, 0.5), 1.0, True,
        ),
        Metric(
            "tool_p99_mm", "error of the distance from the tool, 99 % of frames below", "mm",
            lambda t: _quantile_mm(t.tool_errors_m, 0.99), 1.0, True,
        ),
        Metric(
            "tool_p1_mm", "error of the distance from the tool, 1 % of frames below", "mm",
            lambda t: _quantile_mm(t.tool_errors_m, 0.01), 1.0, True,
        ),
        Metric(
            "camera_median_mm", "error of the distance from the camera, median", "mm",
            lambda t: _quantile_mm(t.camera_errors_m, 0.5), 1.0, True,
        ),
        Metric(
            "camera_p99_mm", "error of the distance from the camera, 99 % of frames below", "mm",
            lambda t: _quantile_mm(t.camera_errors_m, 0.99), 1.0, True,
        ),
        Metric(
            "camera_p1_mm", "error of the distance from the camera, 1 % of frames below", "mm",
            lambda t: _quantile_mm(t.camera_errors_m, 0.01), 1.0, True,
        ),
    )
}  # fmt: skip

RECALLS = ("recall_percent", "recall_strict_percent", "lost_percent", "false_per_1000")
ERRORS = ("tool_median_mm", "tool_p99_mm", "tool_p1_mm", "camera_median_mm", "camera_p99_mm", "camera_p1_mm")

REASONS = (
    "The halo of stereo makes things some 30 mm larger, and a voxel counts as a cube. Ours keeps the"
    " voxels at the rim of a thing, so it shows the thing nearer than it is, and nearer than a rule "
    "that deletes these voxels. A rule that loses the thing in some frames has no figure for 99 %.",
    "Close to a known surface ours sees nothing within a margin that grows with noise. A smaller "
    "fixed limit sees more there, but reports the noise of everything farther away.",
    "The noise of a real camera at 3.5 m lies above the square law of our margin, so a wall in CAD "
    "gives a few false voxels.",
    "The halo of a near thing can cover a farther one. Its pixels then show the near thing: no rule "
    "finds unmeasured surfaces, but a rule of five points may still find a few points between.",
)

COMPARED = (
    "recall_percent",
    "recall_strict_percent",
    "lost_percent",
    "false_per_1000",
    "tool_median_mm",
    "tool_p99_mm",
)
COMPARED_AXES = ("distance", "voxel", "stand-off", "wall", "quiet")
"""Axes on which a figure can be better or worse, and x has the same meaning for all contenders."""

AXES = {
    axis.key: axis
    for axis in (
        Axis("distance", "distance of the thing's middle", "m", RECALLS + ERRORS, "50 mm voxels, wall 1 m behind"),
        Axis("voxel", "edge of a voxel", "mm", RECALLS + ERRORS, "thing at 1.5 m, wall 1 m behind"),
        Axis(
            "threshold", "threshold of density", "of a full voxel", RECALLS,
            "thing at 1.5 m, 50 mm voxels; ours counts a full voxel by the pinhole and its neighbours too, the paper "
            "by angles and each voxel by itself",
        ),
        Axis("points", "least points in a voxel", "points", RECALLS, "thing at 1.5 m, 50 mm voxels"),
        Axis(
            "stand-off", "distance of the front from the wall", "mm", RECALLS,
            "an arm parallel to the wall, 50 mm voxels: things closer to a known surface than the margin are"
            " not seen",
        ),
        Axis(
            "limit", "fixed offset before the known surface", "mm", RECALLS,
            "thing at 2.5 m, wall 1 m behind; ours computes its own margin, and its line is drawn over all "
            "of the axis",
        ),
        Axis("wall", "distance of the wall", "m", ("false_per_1000",), "a wall in CAD, square to the camera, alone"),
        Axis("quiet", "camera of the demo cell", "number", ("false_per_1000",), "only the robot moves"),
    )
}  # fmt: skip


class Collection:
    """Tallies by axis, subject, contender and x."""

    def __init__(self) -> None:
        self._tallies: dict[tuple[str, str], dict[tuple[str, float], Tally]] = defaultdict(lambda: defaultdict(Tally))

    def add(self, subject: str, tallies: Tallies, in_sum: bool) -> None:
        """Count the tallies of one trial. With `in_sum` they also count for `EVERYTHING`."""
        for entry, tally in tallies:
            for name in (subject, EVERYTHING) if in_sum else (subject,):
                self._tallies[entry.axis, name][entry.contender, entry.x].add(tally)

    def tally(self, axis: str, subject: str, contender: str, x: float | None = None) -> Tally:
        """Return the tally of one point, or of all points of a line if `x` is None."""
        total = Tally()
        for (name, at), tally in self._tallies[axis, subject].items():
            if name == contender and x in (None, at):
                total.add(tally)
        return total

    def curves(self) -> list[Curve]:
        """Return all curves, in the order of the axes and of their metrics."""
        found = []
        for axis in AXES.values():
            subjects = [name for key, name in self._tallies if key == axis.key]
            if len(subjects) == 2 and EVERYTHING in subjects:
                subjects.remove(EVERYTHING)
            for subject in subjects:
                tallies = self._tallies[axis.key, subject]
                for metric in (METRICS[key] for key in axis.metrics):
                    if all(tally.visible == 0 for tally in tallies.values()) and metric.key != "false_per_1000":
                        continue
                    series: dict[str, list[tuple[float, float]]] = defaultdict(list)
                    for (contender, x), tally in sorted(tallies.items(), key=lambda point: point[0][1]):
                        if contender == CEILING and not metric.key.startswith("recall"):
                            continue
                        series[contender].append((x, metric.of(tally)))
                    frames = max(tally.frames for tally in tallies.values())
                    found.append(Curve(axis, metric, subject, dict(series), frames))
        return found


def tables(curves: Sequence[Curve], axis: str, metrics: Mapping[str, str], contenders: tuple[str, ...]) -> list[str]:
    """Return the lines of a table of all subjects of an axis: one row per x, one column per metric and contender."""
    by_subject: dict[str, dict[str, Curve]] = defaultdict(dict)
    for curve in curves:
        if curve.axis.key == axis:
            by_subject[curve.subject][curve.metric.key] = curve
    drawn_by = {
        (curve.metric.key, name) for curve in curves if curve.axis.key == axis for name in curve.series
    }  # fmt: skip
    shown = [(key, name) for key in metrics for name in contenders if (key, name) in drawn_by]
    columns = [AXES[axis].unit, *(f"{name}: {metrics[key]}" for key, name in shown)]
    rows: list[list[str | float]] = []
    for subject, drawn in by_subject.items():
        at = sorted({x for curve in drawn.values() for points in curve.series.values() for x, _ in points})
        for x in at:
            rows.append([subject, x, *(_at(drawn[key], name, x) if key in drawn else math.nan for key, name in shown)])
    return table(("subject", *columns), rows)


def by_thing(curves: Iterable[Curve], axis: str, metric: str, contender: str, things: Sequence[str]) -> Curves:
    """Return one contender's curves of all things in one plot."""
    drawn = {each.subject: each for each in curves if each.axis.key == axis and each.metric.key == metric}
    first = drawn[things[0]].picture
    title = first.title.removesuffix(things[0]) + contender
    series = {thing: drawn[thing].series[contender] for thing in things}
    return Curves(title, first.x_label, first.y_label, series, first.logarithmic)


def worse(curves: Iterable[Curve], ours: str, others: tuple[str, ...]) -> Result:
    """List every figure in which another contender is better than ours at the same x, with the number of places and the
    worst one.
    """
    rows: list[tuple[str | float, ...]] = []
    for curve in curves:
        if curve.axis.key not in COMPARED_AXES or curve.metric.key not in COMPARED or curve.subject == EVERYTHING:
            continue
        for other in others:
            at = [
                (x, mine, _at(curve, other, x))
                for x, mine in curve.series.get(ours, [])
                if _is_worse(curve.metric, mine, _at(curve, other, x))
            ]
            if at:
                x, mine, theirs = max(at, key=lambda point: abs(point[1] - point[2]))
                places = ", ".join(f"{x:g}" for x, _, _ in at)
                where = f"{curve.axis.label} {places} {curve.axis.unit}"
                figure = f"{curve.metric.label}, {curve.metric.unit}"
                rows.append((other, figure, curve.subject, where, x, mine, theirs))
    columns = ("than", "in", "before", "at", "worst at", "ours", "theirs")
    return Result("Figures in which ours is worse", columns, tuple(rows), remarks=REASONS)


def _is_worse(metric: Metric, mine: float, theirs: float) -> bool:
    """Return True if our figure is worse. A missing figure is the worst of all."""
    if math.isnan(theirs):
        return False
    if math.isnan(mine):
        return True
    if metric.of_size:
        return abs(mine) - abs(theirs) > metric.worse_by
    return (mine - theirs) * math.copysign(1.0, metric.worse_by) > abs(metric.worse_by)


def _at(curve: Curve, contender: str, x: float) -> float:
    return next((y for at, y in curve.series.get(contender, []) if at == x), math.nan)


def _short(value: float) -> float | None:
    """Round to five digits, more than the measurement is precise to. NaN becomes None, because JSON has no NaN."""
    return None if math.isnan(value) else float(f"{value:.5g}")
