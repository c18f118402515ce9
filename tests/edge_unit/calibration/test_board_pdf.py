# SPDX-License-Identifier: Apache-2.0
"""The printed board, read back from the PDF's own numbers and compared with the board that cameras detect."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_unit.__main__ import main
from edge_unit.calibration.board_detection import BoardDetector
from edge_unit.calibration.board_layout import BoardLayout
from edge_unit.calibration.board_pdf import page_of, smallest_page
from shared.camera import Intrinsics
from shared.cell import Board
from shared.errors import InputError
from shared.transforms import identity
from simulation.world.world import DEMO_CELL

POINTS_PER_MM = 72.0 / 25.4
PX_PER_MM = 4.0


def layout(kind: str = "grid", square_m: float = 0.05, marker_m: float = 0.04, columns: int = 3) -> BoardLayout:
    document = {"kind": kind, "columns": columns, "rows": 4, "square_m": square_m, "marker_m": marker_m}
    more = {"dictionary": "DICT_4X4_100", "first_marker": 5, "T_world_board": identity().tolist()}
    return BoardLayout.of(Board.from_document({**document, **more}))


def cell_file(folder: Path, board: Board) -> Path:
    names = ("kind", "columns", "rows", "square_m", "marker_m", "dictionary", "first_marker")
    lines = "".join(f"  {name}: {getattr(board, name)}\n" for name in names)
    path = folder / "cell.yaml"
    # The file of the mesh does not exist: printing the board does not need it.
    path.write_text(
        "name: printed\nbox: {min: [0, 0, 0], max: [1, 1, 1]}\n"
        f"static: [{{name: gone, mesh: gone.stl}}]\nboard:\n{lines}"
    )
    return path


def printed(pdf: Path) -> tuple[NDArray[np.float64], tuple[float, float], str]:
    """Rectangles (R, 4) filled black on the page, mm from its top left corner; the page's size in mm; its text."""
    text = pdf.read_text("latin-1")
    found = re.search(r"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", text)
    assert found
    width, height = (float(side) for side in found.groups())
    stream = text[text.index("stream\n") : text.index("endstream")]
    matrix, kept, rectangles = np.eye(3), [], []
    for line in stream.splitlines():
        for numbers, operator in re.findall(r"((?:-?[\d.]+ +)*)(cm|re|q|Q)\b", line):
            values = [float(number) for number in numbers.split()]
            if operator == "q":
                kept.append(matrix)
            elif operator == "Q":
                matrix = kept.pop()
            elif operator == "cm":
                a, b, c, d, e, f = values
                matrix = matrix @ np.array(((a, c, e), (b, d, f), (0, 0, 1)))
            elif " f" in line:
                x, y, w, h = values
                corners = matrix @ np.array(((x, x + w), (y, y + h), (1, 1)))
                rectangles.append((*corners[:2].min(axis=1), *corners[:2].max(axis=1)))
    page = np.array(rectangles)
    in_mm = np.column_stack((page[:, 0], height - page[:, 3], page[:, 2], height - page[:, 1])) / POINTS_PER_MM
    return in_mm, (width / POINTS_PER_MM, height / POINTS_PER_MM), stream


@pytest.mark.parametrize("board", [layout(), layout("charuco", 0.047, 0.0351, 4)], ids=["grid", "charuco"])
def test_a_printed_board_is_detected(board: BoardLayout, tmp_path: Path) -> None:
    pdf = tmp_path / "board.pdf"
    assert main(["board", "--cell", str(cell_file(tmp_path, board.board)), "--out", str(pdf), "--page", "A3"]) == 0
    black_mm, (width_mm, height_mm), text = printed(pdf)
    page = page_of(board, "A3")
    assert sorted((width_mm, height_mm)) == pytest.approx([297.0, 420.0], abs=0.01)
    assert "100 mm: measure me" in text
    assert "DICT_4X4_100" in text
    # OpenCV's own statement: each marker's black border is a frame of the printed rectangles.
    for corners_m in np.array(board.aruco.getObjPoints()):
        x0, y0 = 1e3 * corners_m[0, :2] + (page.left_mm, page.top_mm)
        x1, y1 = 1e3 * corners_m[2, :2] + (page.left_mm, page.top_mm)
        inside = (black_mm[:, :2] > (x0 - 0.1, y0 - 0.1)).all(axis=1) & (black_mm[:, 2:] < (x1 + 0.1, y1 + 0.1)).all(
            axis=1
        )
        outline = (*black_mm[inside, :2].min(axis=0), *black_mm[inside, 2:].max(axis=0))
        assert outline == pytest.approx((x0, y0, x1, y1), abs=0.01)
    # And as a camera would see the page.
    image = np.full((round(height_mm * PX_PER_MM), round(width_mm * PX_PER_MM)), 255, np.uint8)
    for x0, y0, x1, y1 in np.round(black_mm * PX_PER_MM).astype(int):
        image[y0:y1, x0:x1] = 0
    camera = Intrinsics(image.shape[1], image.shape[0], 1000.0, 1000.0, 0.0, 0.0)
    detection = BoardDetector(board, camera).detect(image)
    assert detection.markers == len(board.ids)
    seen_mm = (detection.pixels + 0.5) / PX_PER_MM
    assert seen_mm == pytest.approx(1e3 * detection.points_m[:, :2] + (page.left_mm, page.top_mm), abs=0.2)


def test_the_ruler_is_100_mm(tmp_path: Path) -> None:
    pdf = tmp_path / "board.pdf"
    assert main(["board", "--cell", str(cell_file(tmp_path, layout().board)), "--out", str(pdf)]) == 0
    stream = printed(pdf)[2]
    lines = np.array([
        [float(number) for number in found]
        for found in re.findall(r"n ([-\d.]+) ([-\d.]+) m ([-\d.]+) ([-\d.]+) l", stream)
    ])  # fmt: skip
    ticks_mm = np.unique(lines[(lines[:, 0] == lines[:, 2]) & (lines[:, 1] > 0.15 * 1e3)][:, 0])
    assert np.diff(ticks_mm) == pytest.approx(np.ones(100), abs=0.01)


def test_a_page_that_is_too_small_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "board.pdf"
    assert main(["board", "--cell", str(DEMO_CELL), "--out", str(out), "--page", "A3"]) == 1
    assert "does not fit on A3; expected A0" in capsys.readouterr().err
    assert not out.exists()
    assert smallest_page(layout()) == "A4"
    with pytest.raises(InputError, match="fits no sheet"):
        smallest_page(layout(square_m=0.5))
    with pytest.raises(InputError, match="expected one of A4"):
        page_of(layout(), "Letter")


def test_a_cell_without_a_board_and_a_file_that_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare.yaml"
    bare.write_text("name: bare\nbox: {min: [0, 0, 0], max: [1, 1, 1]}\n")
    assert main(["board", "--cell", str(bare), "--out", str(tmp_path / "board.pdf")]) == 1
    assert "has no board" in capsys.readouterr().err
    assert main(["board", "--cell", str(DEMO_CELL), "--out", str(tmp_path / "none" / "board.pdf")]) == 1
    assert "cannot be written" in capsys.readouterr().err
