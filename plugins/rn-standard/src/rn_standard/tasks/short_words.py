"""Short words for `until`, and what judges the verbs of an instruction when a call names no
predicate.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import get_args

from rn_standard.tasks.detectors import Colour
from roboneuron import InvalidInputError, Verb

COLOURS: tuple[str, ...] = get_args(Colour)
WORDS = '"held", "lifted" or "on COLOUR"'
_ON = re.compile(r"\bon(?:to| top of)?\b(.*)")
_STANDS_S = 0.5
_LIFTED_M = 0.05
Data = dict[str, object]


def expanded(words: str, instruction: str) -> Data:
    """The predicate that short words stand for, as data.

    Args:
        words: "held": the gripper holds something; "lifted": it holds the object of the
            instruction's colour above where it lay; "on blue": that object lies on the blue one.
        instruction: of the task.

    Raises:
        InvalidInputError: other words, or the instruction names no colour or several.
    """
    short = " ".join(words.lower().split())
    if short == "held":
        return _lasting({"kind": "gripper_holds"})
    if short == "lifted":
        lifted = _lifted(_colour_of(instruction))
        return _lasting({"kind": "all", "of": [{"kind": "gripper_holds"}, lifted]})
    if short.startswith("on ") and short[3:] in COLOURS:
        upper = _colour_of(instruction, besides=short[3:])
        return _lasting(
            {"kind": "monitor", "name": "object-on", "options": {"colour": upper, "on": short[3:]}}
        )
    raise InvalidInputError(
        f"`until` is {words[:64]!r}.",
        hint=f"Use {WORDS} ({', '.join(COLOURS)}), or a predicate as an object: see the resource "
        "roboneuron://tasks/predicates.",
        path="until",
    )


def default_predicate(instruction: str, verbs: Sequence[Verb]) -> Data | None:
    """What judges the verb of an instruction, as data; None if it has none of the policy's verbs.

    "on" is judged as "on Y". "lifted" is achieved if the gripper holds something, and the object of
    the instruction's colour is lifted or the policy says that it has finished: what cannot be seen
    leaves no task undecided.
    """
    text = instruction.lower()
    asked = {verb.achieves: after for verb in verbs if (after := _after(verb, text)) is not None}
    if "on" in asked:
        on = _ON.search(asked["on"])
        below = [] if on is None else _colours_in(on.group(1))
        above = [colour for colour in _colours_in(text) if colour not in below]
        is_known = len(below) == 1 and len(above) == 1
        return expanded(f"on {below[0]}", instruction) if is_known else None
    if "lifted" not in asked:
        return None
    signs: list[Data] = [{"kind": "policy_done"}]
    if len(colours := _colours_in(text)) == 1:
        signs.append(_lifted(colours[0]))
    return _lasting(
        {"kind": "all", "of": [{"kind": "gripper_holds"}, {"kind": "any", "of": signs}]}
    )


def _after(verb: Verb, text: str) -> str | None:
    """What follows the first of a verb's words in a text; None without them."""
    found = re.search(rf"\b(?:{'|'.join(map(re.escape, verb.words))})\b(.*)", text, re.DOTALL)
    return None if found is None else found.group(1)


def _lifted(colour: str) -> Data:
    options: Data = {"colour": colour, "height_m": _LIFTED_M}
    return {"kind": "monitor", "name": "colour-lifted", "options": options}


def _lasting(predicate: Data) -> Data:
    return {"kind": "held", "for_s": _STANDS_S, "of": predicate}


def _colours_in(text: str) -> list[str]:
    return [colour for colour in COLOURS if re.search(rf"\b{colour}\b", text.lower())]


def _colour_of(instruction: str, besides: str = "") -> str:
    found = [colour for colour in _colours_in(instruction) if colour != besides]
    if len(found) != 1:
        raise InvalidInputError(
            f"The instruction names {'no' if not found else 'several'} colours "
            f"({', '.join(found) or 'none'}), so that it is not known which object is meant.",
            hint="Name one, or write the predicate out: see roboneuron://tasks/predicates.",
            path="until",
        )
    return found[0]
