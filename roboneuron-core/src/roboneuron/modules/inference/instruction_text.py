"""Validation of instruction texts; light to import."""

from __future__ import annotations

from typing import Annotated
from unicodedata import category

from pydantic import AfterValidator, Field

from roboneuron.errors import InvalidInputError

__all__ = ["InstructionText"]
"""Names that other distributions may use."""

MAX_INSTRUCTION_LENGTH = 1000
"""Maximum length [characters]: models read a few dozen words, and the status repeats it five times
a second.
"""
_BREAKS = "\t\n\r"
"""Control characters allowed between the words of an instruction."""


def instruction_problem(text: str) -> str:
    """Reason why a text is not a valid instruction; empty if it is. ROS ends a text at NUL."""
    if len(text) > MAX_INSTRUCTION_LENGTH:
        return (
            f"The instruction is {len(text)} characters long, at most {MAX_INSTRUCTION_LENGTH} "
            "are allowed"
        )
    for place, character in enumerate(text):
        if category(character) in ("Cc", "Cs") and character not in _BREAKS:
            return (
                f"The instruction holds the control character U+{ord(character):04X} at "
                f"position {place}"
            )
    return ""


def check_instruction(text: str) -> str:
    """Return the instruction without blanks around it.

    Raises:
        InvalidInputError: it is empty, too long or contains a control character.
    """
    if problem := instruction_problem(text):
        raise InvalidInputError(
            f"{problem}.", hint="Write plain text on one line.", path="instruction"
        )
    if not text.strip():
        raise InvalidInputError(
            "The instruction is empty.",
            hint='Say what to do, for instance "pick up the red cube".',
            path="instruction",
        )
    return text.strip()


InstructionText = Annotated[
    str, Field(max_length=MAX_INSTRUCTION_LENGTH), AfterValidator(check_instruction)
]
"""Tool argument `instruction`, validated by `check_instruction`."""
