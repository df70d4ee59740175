"""Findings of the checks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

from roboneuron.feature import Config


class Severity(StrEnum):
    """Severity of a finding: only FAILED keeps RoboNeuron from working."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """Answer of a check.

    Attributes:
        verdict: its severity.
        text: the observation, one sentence.
        hint: a remedy; empty if none is necessary.
    """

    verdict: Severity
    text: str
    hint: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Check:
    """A question and the function that answers it.

    Attributes:
        id: stable word, for programs.
        question: for users.
        answer: performs the check; any exception counts as failed.
        needs: id of an earlier check on which this one depends.
    """

    id: str
    question: str
    answer: Callable[[Config], Finding]
    needs: str = ""


@runtime_checkable
class Examining(Protocol):
    """Optional interface of a plugin's command, for checks in `roboneuron doctor`."""

    def findings(self) -> Iterable[tuple[bool, str, str]]:
        """Return findings: success, observation in one sentence, and remedy; empty if the plugin
        has nothing to check. Raises RoboNeuronError for a broken part.
        """


def ok(text: str) -> Finding:
    """Create a finding without problems."""
    return Finding(verdict=Severity.OK, text=text)


def warning(text: str, hint: str) -> Finding:
    """Create a finding that works, but with a warning."""
    return Finding(verdict=Severity.WARNING, text=text, hint=hint)


def failed(text: str, hint: str) -> Finding:
    """Create a finding of a failure."""
    return Finding(verdict=Severity.FAILED, text=text, hint=hint)
