"""The calibration board: a chessboard whose white squares hold AprilTags (ChArUco), printed at true
size and found in pictures by OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from roboneuron import ConfigurationError, InvalidInputError

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

DOTS_PER_MM = 20
"""508 dots per inch: of squares of 5, 10, ... mm every edge is a whole number of dots."""
_TAG_SHARE = 0.72
"""Edge of a tag by that of its square: with larger ones corners are found less exactly."""
_TAG_CELLS = 8
"""Of an edge of a tag, its black frame included."""
PAPERS_MM = {"a4": (297, 210), "a3": (420, 297), "letter": (279, 216)}
"""Width and height of paper that lies across."""
MARGIN_MM = 12
"""Left free: printers leave out what is nearer to the paper's edge, and tags need white around
them.
"""
LEAST_CORNERS = 8
"""Fewer corners of a board in a picture are not used: their pose would be uncertain."""
RULER_MM = 100


@dataclass(frozen=True, kw_only=True, slots=True)
class Board:
    """A chessboard of `columns` x `rows` squares with an AprilTag 36h11 in each white one.

    Its frame has its origin in the outer corner at the upper left, x along the upper edge to the
    right, y down, z into the paper.

    Attributes:
        columns, rows: numbers of squares, at least 3.
        square_m: edge of a square [m], as measured on the print.
    """

    columns: int = 8
    rows: int = 6
    square_m: float = 0.03

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or self.columns * self.rows > 1000:
            raise InvalidInputError(
                f"A board of {self.columns} x {self.rows} squares: expected 3 x 3 to 1000 in all."
            )
        if not 0.001 <= self.square_m <= 1.0:
            raise InvalidInputError(f"A square of {self.square_m:g} m: expected 0.001 to 1.")

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.columns * self.square_m, self.rows * self.square_m

    @property
    def outer_corners_m(self) -> F64:
        """float64 (4, 3): its outer corners 1 to 4, clockwise from the upper left, in its frame."""
        width_m, height_m = self.size_m
        return np.array([[0, 0, 0], [width_m, 0, 0], [width_m, height_m, 0], [0, height_m, 0.0]])

    @property
    def corners_m(self) -> F64:
        """float64 (n, 3): its inner corners by number, in its frame."""
        return np.asarray(self._charuco().getChessboardCorners(), dtype=np.float64)

    def find(self, rgb: U8) -> BoardCorners | None:
        """Find its inner corners in a picture, uint8 (H, W, 3); None if fewer than LEAST_CORNERS
        are seen.
        """
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(self._charuco()).detectBoard(grey)
        if numbers is None or len(numbers) < LEAST_CORNERS:
            return None
        return BoardCorners(
            numbers=np.asarray(numbers, dtype=np.int64).reshape(-1),
            pixels=np.asarray(corners, dtype=np.float64).reshape(-1, 2),
        )

    def draw(self) -> U8:
        """uint8 (h, w), black on white, without a margin; DOTS_PER_MM.

        Raises:
            InvalidInputError: the cells of its tags are no whole number of dots.
        """
        side = self.square_m * 1000 * DOTS_PER_MM
        cell = _TAG_SHARE * side / _TAG_CELLS
        if abs(cell - round(cell)) > 1e-6:
            raise InvalidInputError(
                f"A square of {self.square_m * 1000:g} mm cannot be printed exactly.",
                hint="Choose 5, 10, 15, ... mm.",
            )
        size = (self.columns * round(side), self.rows * round(side))
        return np.asarray(self._charuco().generateImage(size, marginSize=0, borderBits=1))

    def _charuco(self) -> cv2.aruco.CharucoBoard:
        tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, _TAG_SHARE * self.square_m, tags
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class BoardCorners:
    """A board's inner corners in a picture.

    Attributes:
        numbers: int64 (n,), rows of `Board.corners_m`.
        pixels: float64 (n, 2), pixel centres at integers.
    """

    numbers: NDArray[np.int64]
    pixels: F64


def print_board(board: Board, path: Path, paper: str) -> None:
    """Write a page at true size: the board, the numbers of its outer corners, and a line of
    RULER_MM to check the print by.

    Args:
        board: printed in its own size.
        path: a .pdf or .png file.
        paper: one of PAPERS_MM.

    Raises:
        ConfigurationError: the board does not fit on the paper, or another kind of file.
        InvalidInputError: as `Board.draw`.
        OSError: the file cannot be written.
    """
    if path.suffix.lower() not in (".pdf", ".png"):
        raise ConfigurationError(f"{path} is no .pdf or .png file.")
    drawn, across = board.draw(), PAPERS_MM[paper]
    room = [side - 2 * MARGIN_MM for side in across]
    width_mm, height_mm = (1000 * side for side in board.size_m)
    if width_mm > room[0] or height_mm > room[1]:
        raise ConfigurationError(
            f"The board has {width_mm:g} x {height_mm:g} mm, {paper} has room for {room[0]} x "
            f"{room[1]}.",
            hint="Choose smaller or fewer squares, or another --paper.",
        )
    page = Image.new("L", (across[0] * DOTS_PER_MM, across[1] * DOTS_PER_MM), 255)
    left, top = (page.width - drawn.shape[1]) // 2, (page.height - drawn.shape[0]) // 2
    page.paste(Image.fromarray(drawn), (left, top))
    _label(page, board, (left, top, left + drawn.shape[1], top + drawn.shape[0]))
    dots_per_inch = 25.4 * DOTS_PER_MM
    page.convert("1").save(path, resolution=dots_per_inch, dpi=(dots_per_inch, dots_per_inch))


def _label(page: Image.Image, board: Board, box: tuple[int, int, int, int]) -> None:
    """Draw what a person reads and touches beside the board."""
    draw = ImageDraw.Draw(page)
    font = ImageFont.load_default(size=4 * DOTS_PER_MM)
    left, top, right, bottom = box
    step = DOTS_PER_MM
    corners = (
        (left, top, -1, -1),
        (right, top, 1, -1),
        (right, bottom, 1, 1),
        (left, bottom, -1, 1),
    )
    for number, (x, y, outwards, along) in enumerate(corners, start=1):
        # white squares end there: lines point at the corner
        draw.line([(x + outwards * step, y), (x + 4 * outwards * step, y)], fill=0, width=4)
        draw.line([(x, y + along * step), (x, y + 4 * along * step)], fill=0, width=4)
        anchor = ("r" if outwards < 0 else "l") + ("s" if along < 0 else "t")
        place = (x + 2 * outwards * step, y + 2 * along * step)
        draw.text(place, str(number), fill=0, font=font, anchor=anchor)
    line_y = bottom + 6 * step
    start, end = left + 8 * step, left + (8 + RULER_MM) * step
    draw.line([(start, line_y), (end, line_y)], fill=0, width=6)
    for x in (start, end):
        draw.line([(x, line_y - step), (x, line_y + step)], fill=0, width=6)
    text = (
        f"{RULER_MM} mm if printed at 100 %.   {board.columns} x {board.rows} squares of "
        f"{board.square_m * 1000:g} mm, AprilTag 36h11"
    )
    draw.text((end + 3 * step, line_y), text, fill=0, font=font, anchor="lm")
