"""`roboneuron robot cameras board`: every edge on paper has its length, the board is found."""

from __future__ import annotations

import re

import numpy as np
import pytest
from PIL import Image

from rn_cameras.board import DOTS_PER_MM, Board, print_board
from roboneuron import ConfigurationError, InvalidInputError


@pytest.mark.parametrize(
    ("paper", "board"),
    [
        ("a4", Board()),
        ("a3", Board(columns=7, rows=5, square_m=0.05)),
    ],
    ids=["a4", "a3"],
)
def test_corners_of_a_print_are_where_the_board_has_them(tmp_path, paper, board):
    print_board(board, tmp_path / "board.png", paper)
    with Image.open(tmp_path / "board.png") as page:
        assert page.info["dpi"] == pytest.approx((25.4 * DOTS_PER_MM,) * 2, rel=1e-4)
        dots_per_mm = 4
        size = [side * dots_per_mm // DOTS_PER_MM for side in page.size]
        small = np.array(page.convert("RGB").resize(size, Image.Resampling.BOX))
    found = board.find(small)
    assert len(found.numbers) == (board.columns - 1) * (board.rows - 1)
    # pixel centres are at integers, edges of dots between them
    seen_mm = (found.pixels + 0.5) / dots_per_mm
    own_mm = board.corners_m[found.numbers, :2] * 1000
    assert np.ptp(seen_mm - own_mm, axis=0) == pytest.approx(0, abs=0.1)


def test_a_page_of_a_pdf_has_the_size_of_the_paper(tmp_path):
    print_board(Board(), tmp_path / "board.pdf", "letter")
    text = (tmp_path / "board.pdf").read_bytes().decode("latin-1")
    width, height = re.search(r"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", text).groups()
    assert (float(width), float(height)) == pytest.approx((279 / 25.4 * 72, 216 / 25.4 * 72))


@pytest.mark.parametrize(
    ("board", "file", "paper", "error"),
    [
        (Board(square_m=0.04), "board.pdf", "a4", ConfigurationError),
        (Board(), "board.jpg", "a4", ConfigurationError),
        (Board(square_m=0.0301), "board.pdf", "a4", InvalidInputError),
    ],
    ids=["too large", "other file", "no whole dots"],
)
def test_what_cannot_be_printed_at_true_size_is_refused(tmp_path, board, file, paper, error):
    with pytest.raises(error):
        print_board(board, tmp_path / file, paper)
    assert not (tmp_path / file).exists()


@pytest.mark.parametrize(
    "values", [{"columns": 2}, {"rows": 2}, {"columns": 100, "rows": 100}, {"square_m": 0.0}]
)
def test_impossible_boards_are_refused(values):
    with pytest.raises(InvalidInputError):
        Board(**values)
