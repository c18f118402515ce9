# SPDX-License-Identifier: Apache-2.0
"""The calibration board on paper: positions of all printed parts, in the board's own frame.

All of it comes from OpenCV's board, which cameras also detect: printed, detected and simulated boards are one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.cell import Board
from shared.errors import CellError, InputError

BORDER_CELLS = 1
"""Black cells about a marker's code, on each side: OpenCV's default, which detectors expect."""


@dataclass(frozen=True, eq=False)
class BoardLayout:
    """A board in OpenCV's terms.

    Attributes:
        board: the board's description in the cell.
        aruco: OpenCV's board object.
        dictionary: the dictionary of its markers.
        ids: (M,) ids of its markers.
        marker_corners_m: (M, 4, 2) x and y in the board's frame, clockwise as printed from the top left.
        size_m: width and height of the printed pattern.
    """

    board: Board
    aruco: cv2.aruco.Board
    dictionary: cv2.aruco.Dictionary
    ids: NDArray[np.intp]
    marker_corners_m: NDArray[np.float64]
    size_m: tuple[float, float]

    @classmethod
    def of(cls, board: Board) -> BoardLayout:
        """Make the layout of `board`.

        Raises:
            CellError: OpenCV has no such dictionary, or the dictionary has too few markers.
        """
        name = board.dictionary
        number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
        if not isinstance(number, int):
            raise CellError(f"board.dictionary: expected one of OpenCV's, such as DICT_5X5_250, got {name}")
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        cells = board.columns * board.rows
        count = cells // 2 if board.kind == "charuco" else cells
        ids = np.arange(board.first_marker, board.first_marker + count)
        available = len(dictionary.bytesList)
        if board.first_marker + count > available:
            raise CellError(
                f"board: expected its {count} markers from {board.first_marker} on in {name}, which has {available}"
            )
        size = (board.columns, board.rows)
        gap_m = board.square_m - board.marker_m
        try:
            aruco: cv2.aruco.Board
            if board.kind == "charuco":
                aruco = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary, ids)
                width_m, height_m = board.columns * board.square_m, board.rows * board.square_m
            else:
                aruco = cv2.aruco.GridBoard(size, board.marker_m, gap_m, dictionary, ids)
                width_m, height_m = board.columns * board.square_m - gap_m, board.rows * board.square_m - gap_m
        except cv2.error as error:
            raise CellError(f"board: OpenCV cannot make it: {error.err}") from error
        # OpenCV keeps float32; a tenth of a micrometre is what they mean.
        corners_m = np.round(np.array(aruco.getObjPoints(), dtype=np.float64)[:, :, :2], 7)
        return cls(board, aruco, dictionary, ids, corners_m, (width_m, height_m))

    @property
    def black_m(self) -> NDArray[np.float64]:
        """Return (R, 4) rectangles x0, y0, x1, y1, in the board's frame, of all black areas; none overlaps another."""
        found: list[tuple[float, float, float, float]] = []
        board = self.board
        if board.kind == "charuco":
            square_m = board.square_m
            found += [
                (column * square_m, row * square_m, (column + 1) * square_m, (row + 1) * square_m)
                for row in range(board.rows)
                for column in range(board.columns)
                if (row + column) % 2 == 0
            ]
        cells = self.dictionary.markerSize + 2 * BORDER_CELLS
        for marker_id, corners_m in zip(self.ids, self.marker_corners_m, strict=True):
            (x_m, y_m), cell_m = corners_m[0], board.marker_m / cells
            code = self.dictionary.generateImageMarker(int(marker_id), cells, None, BORDER_CELLS)
            for row, line in enumerate(code):
                # Whole runs: seams between cells would be visible in print.
                edges = np.flatnonzero(np.diff(np.concatenate(([255], line, [255])).astype(np.int16)))
                for first, last in edges.reshape(-1, 2):
                    found.append(
                        (x_m + first * cell_m, y_m + row * cell_m, x_m + last * cell_m, y_m + (row + 1) * cell_m)
                    )
        return np.array(found)


def require_board(board: Board | None) -> Board:
    """Return the cell's board.

    Raises:
        InputError: the cell has no board.
    """
    if board is None:
        raise InputError("the cell has no board: describe the printed one under `board` in cell.yaml")
    return board
