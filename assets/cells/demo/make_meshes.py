# SPDX-License-Identifier: Apache-2.0
"""Writes the STL files of the demo cell: `python assets/cells/demo/make_meshes.py`.

Furniture is in metres, the gripper in millimetres, as CAD systems export it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import trimesh

FOLDER = Path(__file__).parent

Size = tuple[float, float, float]
Block = tuple[Size, Size]
"""Edges of a block, and where the middle of its underside stands."""


def write(name: str, blocks: Iterable[Block], others: Iterable[trimesh.Trimesh] = ()) -> None:
    """Write blocks and other solids as one binary STL."""
    parts = list(others)
    for (size_x, size_y, size_z), (x, y, z) in blocks:
        part = trimesh.creation.box(extents=(size_x, size_y, size_z))
        part.apply_translation((x, y, z + size_z / 2.0))
        parts.append(part)
    trimesh.util.concatenate(parts).export(FOLDER / f"{name}.stl", file_type="stl")


def table() -> list[Block]:
    """1.2 x 0.8 m, origin in the middle of the table top's upper face, 0.75 m above the floor."""
    legs: list[Block] = [((0.06, 0.06, 0.71), (x, y, -0.75)) for x in (-0.55, 0.55) for y in (-0.35, 0.35)]
    return [((1.2, 0.8, 0.04), (0.0, 0.0, -0.04)), *legs]


def shelf() -> list[Block]:
    """0.8 x 0.35 x 1.3 m, open to its +y side, origin on the floor below its middle."""
    sides: list[Block] = [((0.02, 0.35, 1.3), (x, 0.0, 0.0)) for x in (-0.39, 0.39)]
    boards: list[Block] = [((0.76, 0.33, 0.02), (0.0, 0.01, z)) for z in (0.1, 0.5, 0.9, 1.28)]
    back: Block = ((0.76, 0.02, 1.3), (0.0, -0.165, 0.0))
    return [*sides, *boards, back]


def tray() -> list[Block]:
    """0.3 x 0.2 x 0.1 m, open at the top, origin in the middle of its underside."""
    long_sides: list[Block] = [((0.3, 0.01, 0.09), (0.0, y, 0.01)) for y in (-0.095, 0.095)]
    short_sides: list[Block] = [((0.01, 0.18, 0.09), (x, 0.0, 0.01)) for x in (-0.145, 0.145)]
    return [((0.3, 0.2, 0.01), (0.0, 0.0, 0.0)), *long_sides, *short_sides]


def gripper() -> tuple[list[Block], list[trimesh.Trimesh]]:
    """A parallel gripper of 120 mm along z from the robot's flange, in millimetres."""
    body = trimesh.creation.cylinder(radius=32.0, height=60.0, sections=48)
    body.apply_translation((0.0, 0.0, 30.0))
    fingers: list[Block] = [((14.0, 20.0, 60.0), (x, 0.0, 60.0)) for x in (-22.0, 22.0)]
    return fingers, [body]


if __name__ == "__main__":
    write("table", table())
    write("shelf", shelf())
    write("tray", tray())
    write("gripper_mm", *gripper())
