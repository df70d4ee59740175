"""`until` takes short words; the verbs of an instruction are judged without any."""

from __future__ import annotations

import json
from typing import Any

import pytest

from rn_standard.tasks.predicates import flat, parse_predicate
from rn_standard.tasks.short_words import expanded
from rn_standard.tasks.task_judge import predicate_of
from roboneuron import PICK_AND_PLACE, InvalidInputError

PICK, PUT = "pick up the red cube", "put the red cube on the blue one"


def kinds(data: Any) -> set[str]:
    return {part.kind for part in flat(parse_predicate(data))}


@pytest.mark.parametrize(
    ("words", "instruction", "expected"),
    [
        ("held", "anything", {"held", "gripper_holds"}),
        ("lifted", PICK, {"held", "all", "gripper_holds", "monitor"}),
        ("On  Blue", PUT, {"held", "monitor"}),
    ],
)
def test_short_words_stand_for_a_predicate(
    words: str, instruction: str, expected: set[str]
) -> None:
    assert kinds(expanded(words, instruction)) == expected


def test_the_objects_are_those_of_the_instruction() -> None:
    told = json.dumps(expanded("on blue", PUT))
    assert '{"colour": "red", "on": "blue"}' in told
    assert '"colour": "red"' in json.dumps(expanded("lifted", PICK))


@pytest.mark.parametrize(
    ("words", "instruction"),
    [
        ("done", PICK),
        ("on mars", PUT),
        ("lifted", "pick it up"),
        ("lifted", "pick up red and green"),
        ("on blue", "put it on the blue one"),
    ],
)
def test_other_words_are_refused_with_what_is_possible(words: str, instruction: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        expanded(words, instruction)
    assert caught.value.path == "until"
    assert "roboneuron://tasks/predicates" in caught.value.hint


@pytest.mark.parametrize(
    ("instruction", "judged"),
    [
        (PICK, {"held", "all", "any", "gripper_holds", "policy_done", "monitor"}),
        ("Grasp the ball", {"held", "all", "any", "gripper_holds", "policy_done"}),
        (PUT, {"held", "monitor"}),
        ("stack red on blue", {"held", "monitor"}),
        ("put it down", set()),
        ("put red on the table", set()),
        ("wave", set()),
        ("take a picture", set()),
    ],
)
def test_the_verb_of_an_instruction_is_judged_by_itself(instruction: str, judged: set[str]) -> None:
    predicate = predicate_of(instruction, None, PICK_AND_PLACE)
    assert (set() if predicate is None else {part.kind for part in flat(predicate)}) == judged


@pytest.mark.parametrize("instruction", [PICK, PUT])
def test_a_policy_that_declares_no_verbs_needs_a_predicate(instruction: str) -> None:
    assert predicate_of(instruction, None, ()) is None


def test_only_the_verbs_that_a_policy_declares_are_judged() -> None:
    (pick, _) = PICK_AND_PLACE
    assert predicate_of(PICK, None, [pick]) is not None
    assert predicate_of(PUT, None, [pick]) is None


def test_what_the_call_names_comes_first() -> None:
    predicate = predicate_of(PICK, {"kind": "policy_done"}, PICK_AND_PLACE)
    assert predicate is not None
    assert predicate.kind == "policy_done"
