# SPDX-License-Identifier: Apache-2.0
"""Write the STL files of this folder's cell, then load the cell: `python examples/cell_from_stl/make_stl.py`.

`--out` names another folder, to which `cell.yaml` is copied. For an own cell, export the files from CAD instead.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import trimesh

from shared.cell import Cell

FOLDER = Path(__file__).parent
SOLIDS = {
    "table.stl": trimesh.creation.box(bounds=[[-600, -400, -40], [600, 400, 0]]),  # mm, its top at z = 0
    "post.stl": trimesh.creation.cylinder(radius=0.05, height=1.2),  # m, about its middle
    "crate.stl": trimesh.creation.box(bounds=[[-150, -100, 0], [150, 100, 200]]),  # mm
}


def main() -> None:
    """Write the files and print what the cell holds."""
    parser = argparse.ArgumentParser(description="write the STL files of a small cell")
    parser.add_argument("--out", type=Path, default=FOLDER)
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for name, solid in SOLIDS.items():
        solid.export(out / name)
    if out.resolve() != FOLDER.resolve():
        shutil.copy(FOLDER / "cell.yaml", out)

    cell = Cell.load(out / "cell.yaml")
    for body in (*cell.static, *cell.objects):
        print(f"{body.name}: {len(body.mesh.faces)} triangles")
    print(f"master-server --cell {out / 'cell.yaml'} --state-dir state")


if __name__ == "__main__":
    main()
