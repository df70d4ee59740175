"""Grounding of instructions: a known verb and one known colour, or an UngroundedError that lists
the known words.
"""

from __future__ import annotations

import re

from roboneuron import UngroundedError

COLOUR_BY_WORD = {
    "red": "red",
    "crimson": "red",
    "scarlet": "red",
    "orange": "orange",
    "yellow": "yellow",
    "green": "green",
    "blue": "blue",
    "purple": "purple",
    "violet": "purple",
}
"""Known colour words; the values are the colours that can be found in images."""

VERBS = (
    "pick",
    "grab",
    "grasp",
    "take",
    "lift",
    "raise",
    "get",
    "fetch",
    "seize",
    "collect",
    "hold",
)
"""Verbs for grasping and lifting."""

_OBJECTS = frozenset(
    {"cube", "block", "box", "brick", "dice", "die", "one", "object", "thing", "item"}
)
_ADJECTIVES = frozenset(
    {
        "small",
        "little",
        "tiny",
        "big",
        "large",
        "wooden",
        "plastic",
        "toy",
        "coloured",
        "colored",
        "solid",
        "bright",
    }
)
_AFTER_THE_COLOUR = frozenset(
    {
        "up",
        "please",
        "now",
        "from",
        "on",
        "off",
        "at",
        "in",
        "for",
        "with",
        "using",
        "that",
        "which",
        "out",
        "over",
    }
)
_OTHER_ACTIONS = frozenset(
    {
        "put",
        "place",
        "drop",
        "release",
        "push",
        "pull",
        "move",
        "throw",
        "stack",
        "pour",
        "open",
        "close",
        "rotate",
        "turn",
        "press",
        "slide",
        "touch",
        "hand",
        "give",
        "bring",
        "insert",
        "wipe",
        "swap",
        "knock",
    }
)
_NEGATIONS = frozenset(
    {"not", "don", "dont", "never", "no", "avoid", "without", "except", "stop", "cancel", "ignore"}
)


def _known() -> str:
    colours = ", ".join(dict.fromkeys(COLOUR_BY_WORD.values()))
    return (
        f'Say for instance "pick up the red cube". Colours: {colours}. Verbs: {", ".join(VERBS)}.'
    )


def parse_instruction(instruction: str) -> str:
    """Return the colour of the cube to pick up.

    Case, punctuation and politeness do not matter; English only.

    Raises:
        UngroundedError: no verb, an action other than picking up, a negation, no colour, several
            colours, or an object other than a cube; the hint lists the known words.
    """
    words = re.findall(r"[^\W\d_]+", instruction.lower())
    if not words:
        raise UngroundedError("The instruction is empty.", hint=_known())
    quoted = f"The instruction {instruction.strip()!r}"
    negation = next((word for word in words if word in _NEGATIONS), None)
    if negation is not None:
        raise UngroundedError(
            f"{quoted} says {negation!r}; only plain requests are understood.", hint=_known()
        )
    other = next((word for word in words if word in _OTHER_ACTIONS), None)
    if other is not None:
        raise UngroundedError(
            f"{quoted} asks to {other!r}; this backend only picks up.", hint=_known()
        )
    if not any(word in VERBS for word in words):
        raise UngroundedError(f"{quoted} has no verb that is understood.", hint=_known())
    colours = list(dict.fromkeys(COLOUR_BY_WORD[word] for word in words if word in COLOUR_BY_WORD))
    if not colours:
        raise UngroundedError(f"{quoted} names no known colour.", hint=_known())
    if len(colours) > 1:
        raise UngroundedError(
            f"{quoted} names {' and '.join(colours)}; one at a time.", hint=_known()
        )
    _check_object(words, quoted)
    return colours[0]


_HAND_OVER = ("hand", "pass", "give")
"""Verbs for picking up with one arm and handing over to the other."""


def parse_hand_over(instruction: str) -> str:
    """Return the colour of the cube to hand over.

    Raises:
        UngroundedError: no verb for handing over; otherwise as `parse_instruction`.
    """
    words = re.findall(r"[^\W\d_]+", instruction.lower())
    if not any(word in _HAND_OVER for word in words):
        raise UngroundedError(
            f"The instruction {instruction.strip()!r} does not ask to hand something over.",
            hint=f'Say for instance "hand over the red cube". Verbs: {", ".join(_HAND_OVER)}.',
        )
    plain = " ".join("take" if word in _HAND_OVER else word for word in words)
    return parse_instruction(plain)


def _check_object(words: list[str], quoted: str) -> None:
    """Raise UngroundedError if the colour is followed by the name of an object that is no cube."""
    last = max(i for i, word in enumerate(words) if word in COLOUR_BY_WORD)
    for word in words[last + 1 :]:
        if word in _OBJECTS or word in _AFTER_THE_COLOUR:
            return
        if word not in _ADJECTIVES:
            raise UngroundedError(
                f"{quoted} names a {word!r}; this backend knows cubes only.", hint=_known()
            )
