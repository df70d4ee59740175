"""The contents of a reply cannot be changed through the array it was created from, nor through its
own field.
"""

from __future__ import annotations

import numpy as np
import pytest

from rn_vla.decoding import RowsReply, TokenReply

MADE = [
    (
        TokenReply,
        {"tokens": np.arange(3, dtype=np.int64), "logits": np.arange(4, dtype=np.float32)},
    ),
    (RowsReply, {"values": np.ones((2, 3), dtype=np.float32)}),
]


@pytest.mark.parametrize(("kind", "arrays"), MADE)
def test_a_buffer_used_again_does_not_change_a_reply(kind, arrays):
    buffers = {field: array.copy() for field, array in arrays.items()}
    made = kind(**buffers)
    for buffer in buffers.values():
        buffer += 1
    for field, array in arrays.items():
        assert np.array_equal(getattr(made, field), array), field


@pytest.mark.parametrize(("kind", "arrays"), MADE)
def test_the_field_of_a_reply_cannot_be_written_to(kind, arrays):
    made = kind(**arrays)
    for field in arrays:
        with pytest.raises(ValueError, match="read-only"):
            getattr(made, field)[...] = 1
