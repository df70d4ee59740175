"""Grounding of the instruction: understood requests, and refusals with the known words."""

from __future__ import annotations

import pytest

from rn_backend_servo.instruction import COLOUR_BY_WORD, VERBS, parse_instruction
from roboneuron.errors import UngroundedError


@pytest.mark.parametrize(
    ("instruction", "colour"),
    [
        ("pick up the red cube", "red"),
        ("grab the blue block", "blue"),
        ("Please lift the green box.", "green"),
        ("take yellow one", "yellow"),
        ("  GET THE PURPLE CUBE!!  ", "purple"),
        ("could you pick the small orange cube up, please?", "orange"),
        ("pick up the violet thing from the table", "purple"),
    ],
)
def test_request_names_one_colour(instruction: str, colour: str) -> None:
    assert parse_instruction(instruction) == colour


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("word", sorted(COLOUR_BY_WORD))
def test_every_known_verb_and_colour_is_understood(verb: str, word: str) -> None:
    assert parse_instruction(f"{verb} the {word} cube") == COLOUR_BY_WORD[word]


@pytest.mark.parametrize(
    ("instruction", "says"),
    [
        ("", "is empty"),
        ("?!", "is empty"),
        ("nimm den roten Würfel", "no verb that is understood"),
        ("拿起红色方块", "no verb that is understood"),
        ("the red cube", "no verb"),
        ("pick up the cube", "names no known colour"),
        ("pick up the red and the blue cube", "names red and blue"),
        ("push the red cube", "asks to 'push'"),
        ("do not pick up the red cube", "says 'not'"),
        ("pick up the red banana", "names a 'banana'"),
    ],
)
def test_anything_else_is_refused_with_what_is_known(instruction: str, says: str) -> None:
    with pytest.raises(UngroundedError) as caught:
        parse_instruction(instruction)
    assert says in caught.value.message
    assert "red, orange, yellow, green, blue, purple" in caught.value.hint
    assert "pick, grab" in caught.value.hint
