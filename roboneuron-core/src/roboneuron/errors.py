"""Deliberate exceptions of RoboNeuron: each has a code, a message and a hint.

There is one class per reaction of the caller, not one per place: fix the configuration, install
something, correct an argument, retry, stop the robot, or report a bug.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from copy import copy
from difflib import SequenceMatcher, get_close_matches
from typing import ClassVar, Self

_TYPING_ERROR, _SAME_START = 0.8, 0.66
"""Similarity of names that differ by a letter or two, and of those that begin with the same letter.
"""
_WORD = re.compile(r"[^A-Za-z0-9]+")


def nearest(name: str, known: Iterable[str], otherwise: str = "", *, likeness: float = 0.6) -> str:
    """Suggest the known name most similar to `name` as a question; `otherwise` if none is similar.

    Shared letters alone do not make a typing error ("options" is not "python", "port" is not
    "transport"): one name has the words of the other, or they differ by a letter or two.
    """
    for close in get_close_matches(name, list(known), n=3, cutoff=likeness):
        words, others = set(_WORD.split(name)), set(_WORD.split(close))
        alike = SequenceMatcher(a=name, b=close).ratio()
        is_likely = alike >= (_SAME_START if close[:1] == name[:1] else _TYPING_ERROR)
        if not likeness or is_likely or words <= others or others <= words:
            return f"Did you mean {close!r}?"
    return otherwise


def shortened(value: object) -> str:
    """Shorten a value from a caller for messages."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


class RoboNeuronError(Exception):
    """Base of all deliberate failures.

    Attributes:
        code: stable machine-readable word, the same for every instance of a class.
        message: one sentence: which one, got, expected.
        hint: one sentence that says what to do; empty if the message already does.
    """

    code: ClassVar[str] = "error"

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message} {self.hint}".strip() if self.hint else self.message

    def with_hint(self, more: str) -> Self:
        """Copy of this error with `more` after its hint, to be raised from this one."""
        told = copy(self)
        told.hint = f"{self.hint} {more}".strip()
        return told


class ConfigurationError(RoboNeuronError):
    """The configuration or a command line names something invalid; fix it and start again."""

    code = "configuration"


class PlanningError(ConfigurationError):
    """The chosen backend, runtime, acceleration, cameras and robot do not fit together; choose
    another combination.
    """

    code = "unfit_combination"


class CheckpointError(ConfigurationError):
    """A model checkpoint is missing, truncated, of another family, or contains unusable values."""

    code = "checkpoint"


class MissingDependencyError(RoboNeuronError):
    """Something must be installed; the hint contains the command."""

    code = "missing_dependency"


class InvalidInputError(RoboNeuronError):
    """An argument or a message is of the wrong type, shape or range; correct it and call again.

    Attributes:
        path: dotted path of the offending field inside the argument, empty for the whole.
    """

    code = "invalid_input"

    def __init__(self, message: str, *, hint: str = "", path: str = "") -> None:
        super().__init__(message, hint=hint)
        self.path = path

    @classmethod
    def unknown_name(cls, where: str, name: object, valid: Sequence[str]) -> Self:
        """Create the error for a name unknown to `where`, with the nearest known one."""
        text = str(name)[:60]
        hint = nearest(text, valid, f"Valid: {', '.join(valid) or 'none'}.")
        return cls(f"{where} has no argument {text!r}.", hint=hint, path=text)

    @classmethod
    def no_choice(cls, path: str, value: object, allowed: Sequence[str]) -> Self:
        """Create the error for a value at `path` that is not allowed, with the nearest
        allowed one.
        """
        listed = ", ".join(allowed[:20]) + (" ..." if len(allowed) > 20 else "")
        meant = nearest(str(value)[:60], allowed)
        message = f"Argument {path!r} is {shortened(value)}. {meant}".rstrip()
        return cls(message, hint=f"Choose one of: {listed}.", path=path)


class ForeignDataError(InvalidInputError):
    """Data from outside (a message, an answer, a file) is not what was agreed; leave that item out.
    The message is part of a sentence, without a full stop.
    """

    code = "foreign_data"


class StateError(RoboNeuronError):
    """The call is valid but not in this state (a second start, a stop of something not running);
    check the status first.
    """

    code = "wrong_state"


class NotReadyError(RoboNeuronError):
    """Something did not become ready in time (no image, no joint state, no answer); fix what is
    named and retry.
    """

    code = "not_ready"


class RefusedError(RoboNeuronError):
    """The gate refused: not allowed, outside a limit, or the emergency stop is latched. Nothing was
    sent.

    Attributes:
        rule: word for the rule that refused, as in the audit and beside the code in the answer. If
            empty, the gate sets it.
    """

    code = "refused"

    def __init__(self, message: str, *, hint: str = "", rule: str = "") -> None:
        super().__init__(message, hint=hint)
        self.rule = rule


class UngroundedError(RoboNeuronError):
    """A backend cannot act on its image or instruction; no action is produced, the robot holds."""

    code = "ungrounded"


class UnsafeError(RoboNeuronError):
    """Continuing could move the robot wrongly (non-finite values, a lost joint); stop the robot."""

    code = "unsafe"


class PluginError(RoboNeuronError):
    """A plugin broke its contract; report it to the plugin's author."""

    code = "plugin_contract"


class InternalError(RoboNeuronError):
    """A defect of RoboNeuron itself; report it with the log."""

    code = "internal"
