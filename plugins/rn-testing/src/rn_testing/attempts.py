"""Start of what a case builds; for an automatic case, a failed start makes the rule not
applicable.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from rn_testing.cases import Case
from rn_testing.rule import NotApplicable
from roboneuron import (
    CheckpointError,
    ConfigurationError,
    MissingDependencyError,
    NotReadyError,
    Spec,
)

T = TypeVar("T")

UNSTARTABLE = (CheckpointError, ConfigurationError, MissingDependencyError, NotReadyError)
"""Errors that an automatic case may raise for lack of options, weights or hardware."""


def attempt(case: Case[Spec], start: Callable[[], T]) -> T:
    """Return the result of `start`; for an automatic case, a failed start makes the rule not
    applicable.
    """
    try:
        return start()
    except UNSTARTABLE as error:
        if case.is_automatic:
            raise NotApplicable(f"cannot be started as it is: {error}") from error
        raise
