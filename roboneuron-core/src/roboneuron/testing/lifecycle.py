"""Starting and ending what a rule tries, and the checks that every lifecycle shares."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from roboneuron.errors import CheckpointError, ConfigurationError, MissingDependencyError, NotReadyError
from roboneuron.testing.cases import Case
from roboneuron.testing.effects import check_released, find_effects, running
from roboneuron.testing.rule import NotApplicable, require

UNSTARTABLE = (CheckpointError, ConfigurationError, MissingDependencyError, NotReadyError)
"""What an automatic case may meet for want of options, weights or hardware."""


class Closable(Protocol):
    """Anything with the end of a lifecycle."""

    def close(self) -> None:
        """Release everything."""
        ...


C = TypeVar("C", bound=Closable)
T = TypeVar("T")


def attempt(case: Case[Any], start: Callable[[], T]) -> T:
    """Return what `start` returns; for an automatic case what cannot start makes the rule not applicable."""
    try:
        return start()
    except UNSTARTABLE as error:
        if case.is_automatic:
            raise NotApplicable(f"cannot be started as it is: {error}") from error
        raise


@contextmanager
def started(case: Case[Any], build: Callable[[], C], start: Callable[[C], None]) -> Iterator[C]:
    """Build and start something, and close it whatever happens."""
    subject = attempt(case, build)
    try:
        attempt(case, lambda: start(subject))
        yield subject
    finally:
        subject.close()


def check_pure_constructor(case: Case[Any], build: Callable[[], object]) -> None:
    """The constructor has no effect but to return an object.

    Options and the target's module are loaded by a first construction, so that only the constructor itself is watched.
    """
    first = attempt(case, build)
    _, effects = find_effects(build)
    del first
    require(not effects, f"the constructor {'; '.join(effects)}")


def check_close_before_start(case: Case[Any], build: Callable[[], Closable]) -> None:
    """`close` may be called twice, and before `load` or `open`."""
    subject = attempt(case, build)
    subject.close()
    subject.close()


def check_close_twice_and_release(case: Case[Any], build: Callable[[], C], start: Callable[[C], None]) -> None:
    """After use `close` may be called twice, and what was started with it has ended."""
    before = running()
    subject = attempt(case, build)
    try:
        attempt(case, lambda: start(subject))
    finally:
        subject.close()
    subject.close()
    check_released(before, "close()")


def check_protocol(subject: object, protocol: type) -> None:
    """`subject` has the methods of a runtime-checkable protocol."""
    missing = [n for n in _methods(protocol) if not callable(getattr(subject, n, None))]
    require(not missing, f"{type(subject).__name__} lacks {', '.join(missing)} of {protocol.__name__}")


def _methods(protocol: type) -> list[str]:
    return sorted(n for n in vars(protocol) if not n.startswith("_") and callable(getattr(protocol, n)))
