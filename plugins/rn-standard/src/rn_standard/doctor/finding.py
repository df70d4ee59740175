"""What a check found."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

from roboneuron.command import Config


class Severity(StrEnum):
    """How bad it is: only FAILED keeps RoboNeuron from working."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """An answer.

    Attributes:
        verdict: how bad it is.
        text: what was seen, one sentence.
        hint: what to do; empty when nothing is to be done.
    """

    verdict: Severity
    text: str
    hint: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Check:
    """A question with a way to answer it.

    Attributes:
        id: stable word, for programs.
        question: for people.
        answer: looks; whatever it raises counts as failed.
        needs: id of an earlier check without which this one would only fail again.
    """

    id: str
    question: str
    answer: Callable[[Config], Finding]
    needs: str = ""


@runtime_checkable
class Examining(Protocol):
    """What a plugin's command may offer so that `roboneuron doctor` asks it too."""

    def findings(self) -> Iterable[tuple[bool, str, str]]:
        """Whether all is well, what was seen, one sentence, and what to do; none where the plugin
        has nothing to look at. Raises RoboNeuronError for what is broken.
        """


def ok(text: str) -> Finding:
    """All is well."""
    return Finding(verdict=Severity.OK, text=text)


def warning(text: str, hint: str) -> Finding:
    """It works, but something is to be known."""
    return Finding(verdict=Severity.WARNING, text=text, hint=hint)


def failed(text: str, hint: str) -> Finding:
    """It will not work."""
    return Finding(verdict=Severity.FAILED, text=text, hint=hint)
