"""CDR that somebody cut or changed: refused or decoded, and what comes after it is not lost."""

from __future__ import annotations

import random
from contextlib import suppress
from typing import Any

import pytest
from made_messages import filled
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message, serialize_message

from rn_interfaces.cdr_fields import CdrError
from rn_interfaces.codec import codec
from rn_interfaces.store import DefinitionStore

TRIALS = pytest.mark.parametrize("trials", [300, pytest.param(3000, marks=pytest.mark.exhaustive)])


def damaged(data: bytes, rng: random.Random) -> bytes:
    """The same bytes, cut somewhere, or with some of them changed."""
    if rng.random() < 0.3:
        return data[: rng.randrange(len(data))]
    changed = bytearray(data)
    for _ in range(rng.randrange(1, 4)):
        changed[rng.randrange(len(changed))] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
    return bytes(changed)


@TRIALS
def test_damaged_messages_are_refused_or_decoded(store: DefinitionStore, trials: int) -> None:
    from weld_msgs.msg import Path as Welds

    rng = random.Random(3)
    ours = codec(Welds)
    refused = 0
    for _ in range(trials):
        message = filled(Welds, rng)
        try:
            ours.decode(damaged(ours.encode(message), rng))
        except CdrError:
            refused += 1
        assert ours.decode(ours.encode(message)) == message
    assert trials // 10 < refused < trials


@TRIALS
def test_rclpy_goes_on_after_damaged_bytes(store: DefinitionStore, trials: int) -> None:
    from weld_msgs.msg import Path as Welds

    rng = random.Random(4)
    decoded = 0
    for _ in range(trials // 3):
        message = filled(Welds, rng)
        data = serialize_message(message)
        with suppress(rclpy_implementation.RMWError):
            deserialize_message(data[:4] + damaged(data[4:], rng), Welds)
            decoded += 1
        assert deserialize_message(data, Welds) == message
    assert 0 < decoded < trials // 3


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("flags", [1, 2, 3, 4, 5], "5 entries, more than 4"),
        ("flags", [300], "cannot be encoded"),
        ("offset", [1.0], "1 entries, not 3"),
        ("tool", "x" * 17, "17 bytes, the type allows 16"),
        ("tool", 5, "cannot be encoded"),
        ("currents", None, "cannot be encoded"),
    ],
)
def test_a_message_that_its_type_has_no_bytes_for_is_refused(
    store: DefinitionStore, field: str, value: Any, words: str
) -> None:
    from weld_msgs.msg import Seam

    message = Seam()
    setattr(message, f"_{field}", value)  # past the checks of rosidl's setters
    with pytest.raises(CdrError, match=words):
        codec(Seam).encode(message)


def test_lengths_beyond_the_bytes_take_no_memory(store: DefinitionStore) -> None:
    from weld_msgs.msg import Path as Welds

    with pytest.raises(CdrError, match="longer than the rest"):
        codec(Welds).decode(b"\xff\xff\xff\x7f" + bytes(64))
