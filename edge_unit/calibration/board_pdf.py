# SPDX-License-Identifier: Apache-2.0
"""The calibration board as a PDF at exact scale: vectors only, with a ruler to check the print."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reportlab.lib import pagesizes
from reportlab.pdfgen.canvas import Canvas

from edge_unit.calibration.board_layout import BoardLayout
from shared.errors import ConfigError, InputError

PAGES = ("A4", "A3", "A2", "A1", "A0")

POINTS_PER_MM = 72.0 / 25.4

PAPER_MARGIN_MM = 5.0
"""Most printers leave this much of the paper white."""

QUIET_MM = 5.0
"""Least white border of the pattern, so that its outermost black is found."""

FOOT_MM = 21.0
"""Space below the pattern, for the ruler and the description of the board."""

RULER_MM = 100
"""Length to measure after printing: printers often shrink a page to fit."""

AXIS_MM = 15.0
"""Length of the frame's arrows, in the white beside the pattern's top left corner."""


@dataclass(frozen=True)
class Page:
    """A sheet, in the orientation that fits the board. `left_mm`, `top_mm`: the pattern's top left corner."""

    name: str
    width_mm: float
    height_mm: float
    left_mm: float
    top_mm: float


def page_of(layout: BoardLayout, name: str) -> Page:
    """Return the sheet of this name, portrait or landscape.

    Raises:
        InputError: there is no such sheet, or the board does not fit; the text names the sheets that it fits.
    """
    if name.upper() not in PAGES:
        raise InputError(f"page: expected one of {', '.join(PAGES)}, got {name}")
    fitting = _fitting(layout, name.upper())
    if fitting is not None:
        return fitting
    width_mm, height_mm = (1e3 * side for side in layout.size_m)
    others = [other for other in PAGES if _fitting(layout, other) is not None]
    raise InputError(
        f"page: the board of {width_mm:g} x {height_mm:g} mm with its margin does not fit on {name.upper()}; "
        f"expected {' or '.join(others) if others else 'a smaller board, for it fits no sheet up to A0'}"
    )


def smallest_page(layout: BoardLayout) -> str:
    """Return the name of the smallest sheet that fits the board.

    Raises:
        InputError: no sheet fits.
    """
    for name in PAGES:
        if _fitting(layout, name) is not None:
            return name
    return page_of(layout, PAGES[-1]).name


def write_board(layout: BoardLayout, path: Path, page: Page) -> None:
    """Print the board into a PDF of one page.

    Raises:
        ConfigError: the file cannot be written.
    """
    size = (page.width_mm * POINTS_PER_MM, page.height_mm * POINTS_PER_MM)
    # Uncompressed it is a few kilobytes, and its numbers can be checked by eye.
    canvas = Canvas(str(path), pagesize=size, pageCompression=0, invariant=1)
    canvas.setTitle(_title(layout))
    # From here on in mm from the pattern's top left corner, y down, like the board's frame.
    canvas.translate(page.left_mm * POINTS_PER_MM, (page.height_mm - page.top_mm) * POINTS_PER_MM)
    canvas.scale(POINTS_PER_MM, -POINTS_PER_MM)
    canvas.setFillGray(0.0)
    for x0, y0, x1, y1 in 1e3 * layout.black_m:
        canvas.rect(x0, y0, x1 - x0, y1 - y0, stroke=0, fill=1)
    _draw_frame(canvas)
    _draw_foot(canvas, layout, page)
    canvas.showPage()
    try:
        canvas.save()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error}") from error


def _fitting(layout: BoardLayout, name: str) -> Page | None:
    width_mm, height_mm = (1e3 * side for side in layout.size_m)
    short_mm, long_mm = (side / POINTS_PER_MM for side in getattr(pagesizes, name))
    # The frame's arrows are drawn into the white beside and above the pattern.
    beside_mm = PAPER_MARGIN_MM + QUIET_MM
    for page_width_mm, page_height_mm in ((short_mm, long_mm), (long_mm, short_mm)):
        free_mm = page_width_mm - width_mm
        rest_mm = page_height_mm - height_mm - FOOT_MM - PAPER_MARGIN_MM - beside_mm
        # A sheet is cut to a millimetre, not better.
        if free_mm >= 2.0 * beside_mm and rest_mm >= 0.0 and page_width_mm >= RULER_MM + 2.0 * beside_mm:
            return Page(name, page_width_mm, page_height_mm, 0.5 * free_mm, beside_mm + 0.5 * rest_mm)
    return None


def _title(layout: BoardLayout) -> str:
    board = layout.board
    what = "squares" if board.kind == "charuco" else "markers"
    pitch = "square" if board.kind == "charuco" else "marker to marker"
    return (
        f"{board.kind}, {board.columns} x {board.rows} {what}, {board.dictionary}, ids {layout.ids[0]} to "
        f"{layout.ids[-1]}, {pitch} {1e3 * board.square_m:g} mm, marker {1e3 * board.marker_m:g} mm"
    )


def _draw_frame(canvas: Any) -> None:
    """Draw origin and axes, just outside the pattern."""
    out_mm = 2.5
    canvas.setLineWidth(0.3)
    for along_x in (True, False):
        canvas.saveState()
        if not along_x:
            canvas.transform(0.0, 1.0, 1.0, 0.0, 0.0, 0.0)
        canvas.line(0.0, -out_mm, AXIS_MM, -out_mm)
        canvas.line(AXIS_MM, -out_mm, AXIS_MM - 2.0, -out_mm - 0.8)
        canvas.line(AXIS_MM, -out_mm, AXIS_MM - 2.0, -out_mm + 0.8)
        canvas.line(0.0, -out_mm - 1.0, 0.0, -out_mm + 1.0)
        canvas.restoreState()
    _text(canvas, AXIS_MM + 1.0, -out_mm + 0.9, 3.0, "x")
    _text(canvas, -out_mm - 0.8, AXIS_MM + 3.4, 3.0, "y")


def _draw_foot(canvas: Any, layout: BoardLayout, page: Page) -> None:
    """Draw the ruler, and the description of the board."""
    top_mm = 1e3 * layout.size_m[1] + QUIET_MM
    left_mm = PAPER_MARGIN_MM + QUIET_MM - page.left_mm
    canvas.setLineWidth(0.15)
    canvas.line(left_mm, top_mm, left_mm + RULER_MM, top_mm)
    for tick in range(RULER_MM + 1):
        length_mm = 4.0 if tick % 10 == 0 else 3.0 if tick % 5 == 0 else 2.0
        canvas.line(left_mm + tick, top_mm, left_mm + tick, top_mm + length_mm)
    _text(canvas, left_mm + RULER_MM + 2.0, top_mm + 3.0, 3.2, f"{RULER_MM} mm: measure me")
    for line, text in enumerate((
        _title(layout) + ".",
        "Print at 100 %, not fitted to the page. Origin at the pattern's top left corner, x right, y down, z into it.",
    )):  # fmt: skip
        _text(canvas, left_mm, top_mm + 8.5 + 4.0 * line, 3.0, text)


def _text(canvas: Any, x_mm: float, y_mm: float, height_mm: float, text: str) -> None:
    """Draw upright text, though y runs down."""
    canvas.saveState()
    canvas.translate(x_mm, y_mm)
    canvas.scale(1.0, -1.0)
    canvas.setFont("Helvetica", height_mm)
    canvas.drawString(0.0, 0.0, text)
    canvas.restoreState()
