"""Rows of foreign bags equal, bit for bit, what the documented rules give: storage x kind of images
x source of the actions x cut of the episodes.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from bag_expectations import expected, mapping_of
from lab_bags import (
    CommandKind,
    CutKind,
    ImageKind,
    lab_events,
    mapping_text,
    picture,
    write_bag,
)

from rn_recorder_bags.bag_files import find_bag
from rn_recorder_bags.importing import row_pictures
from rn_recorder_bags.sampling import sample
from rn_recorder_bags.scanning import scan

EXACT = ("raw", "png")
CELLS = [
    *product(("mcap", "sqlite3"), get_args(ImageKind), get_args(CommandKind), get_args(CutKind))
]


@pytest.mark.sampled(every=17)
@pytest.mark.parametrize(("storage", "images", "commands", "cut"), CELLS)
def test_rows_equal_the_rules(
    tmp_path: Path, storage: str, images: ImageKind, commands: CommandKind, cut: CutKind
) -> None:
    path = write_bag(tmp_path / "bag", storage, lab_events(images, commands, cut))
    mapping = mapping_of(tmp_path, mapping_text(commands, cut))
    bag = find_bag(path)
    scanned = scan(bag, mapping)
    episodes, gaps = sample(scanned, mapping)
    wanted = expected(commands, cut)
    assert [(one.instruction, one.rows) for one in episodes] == [
        (one.instruction, len(one.rows)) for one in wanted
    ]
    for episode, other in zip(episodes, wanted, strict=True):
        times, states, actions, _ = zip(*other.rows, strict=True)
        np.testing.assert_array_equal(episode.times_ns, times)
        np.testing.assert_array_equal(episode.state, states)
        np.testing.assert_array_equal(episode.action, actions)
    shown = [row[3] for one in wanted for row in one.rows]
    for found, number in zip(row_pictures(bag, mapping, ["front"], episodes), shown, strict=True):
        error = np.abs(found["front"].astype(int) - picture(number)).mean()
        assert error == 0 if images in EXACT else error < 3, number
    (jump,) = scanned.left_out
    assert "jumps back by 4.980 s" in jump
    assert any("/lab/cam" in gap for gap in gaps)
