# SPDX-License-Identifier: Apache-2.0
"""Curves as plots."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

SIZE_IN = (7.2, 4.0)
DPI = 110
MARKERS = "osD^vP*X"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#888888")
"""Colours of Okabe and Ito, which people with any kind of colour vision can distinguish."""


def draw(curves: dict[str, Any], folder: Path, prefix: str) -> Path:
    """Draw one document of `report.Curves` into `folder`. Return the path of the PNG, named after its title."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{prefix}_{_slug(curves['title'])}.png"
    figure, axes = plt.subplots(figsize=SIZE_IN, layout="constrained")
    for number, (name, points) in enumerate(curves["series"].items()):
        marker, colour = MARKERS[number % len(MARKERS)], COLOURS[number % len(COLOURS)]
        x, y = [x for x, _ in points], [y for _, y in points]
        # The first line is ours, and lies on top of the others.
        above = len(curves["series"]) - number + 2
        axes.plot(x, y, label=name, marker=marker, color=colour, markersize=4, linewidth=1.4, zorder=above)
    logarithmic = curves.get("logarithmic", "")
    axes.set_xscale("log" if "x" in logarithmic else "linear")
    axes.set_yscale("log" if "y" in logarithmic else "linear")
    if "y" not in logarithmic:
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.set(title=curves["title"], xlabel=curves["x_label"], ylabel=curves["y_label"])
    axes.grid(alpha=0.3)
    if len(curves["series"]) > 1:
        axes.legend(fontsize="small", frameon=False)
    # No date and no version in the file, so that the same plot gives the same file.
    figure.savefig(path, dpi=DPI, metadata={"Software": None})
    plt.close(figure)
    return path


def _slug(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", title.lower()).strip("_")[:60]
