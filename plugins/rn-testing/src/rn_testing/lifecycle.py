"""Start and end of the object under test, and the rules shared by all kinds with a lifecycle."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from rn_testing.attempts import attempt
from rn_testing.cases import Case
from rn_testing.deadline import CALL_LIMIT_S, bounded
from rn_testing.effects import (
    check_memory,
    check_quick,
    check_released,
    check_releases,
    expect_refusal,
    find_effects,
    running,
    within,
)
from rn_testing.fakes import MemoryTopics
from rn_testing.noise import check_quiet
from rn_testing.options import OPTIONS_READ, check_options_read
from rn_testing.process_state import find_changes
from rn_testing.refusals import SECRET, check_error, check_missing_files, secret_options, secrets
from rn_testing.rule import NotApplicable, Rule, Violation, require
from roboneuron import RoboNeuronError, Spec, StateError

PURE = "The constructor opens no file, starts no thread or process, and does no long computation."
"""Text of the rule `constructor-pure`."""
ALONE = (
    "It does not change the process: working directory, environment, signals, global random "
    "generators, logging, standard output."
)
"""Text of the rule `process-left-alone`."""
CONSTRUCTOR_S = 1.0
"""Limit of the quickest of some constructor calls; a busy machine slows single calls, not all."""


class Closable(Protocol):
    """Any object with `close`."""

    def close(self) -> None:
        """Release everything."""
        ...


CaseT = TypeVar("CaseT", bound=Case[Spec])
C = TypeVar("C", bound=Closable)


@contextmanager
def started(case: Case[Spec], build: Callable[[], C], start: Callable[[C], None]) -> Iterator[C]:
    """Build and start an object with every call bounded; close it in any case."""
    subject = bounded(attempt(case, build), case.limits_s)
    try:
        attempt(case, lambda: start(subject))
        yield subject
    finally:
        subject.close()


def check_protocol(case: Case[Spec], protocol: type) -> None:
    """Check that the built object has the methods of a runtime-checkable protocol."""
    subject = attempt(case, case.prepare())
    missing = [n for n in _methods(protocol) if not callable(getattr(subject, n, None))]
    require(
        not missing, f"{type(subject).__name__} lacks {', '.join(missing)} of {protocol.__name__}"
    )


def check_pure_constructor(case: Case[Spec]) -> None:
    """Check that the constructor has no side effects.

    Options, arguments and the target's module are loaded before, and one object is built first, so
    that only the constructor itself is watched.
    """
    build = attempt(case, case.prepare)
    first = attempt(case, build)
    _, effects = find_effects(attempt(case, case.prepare))
    del first
    require(not effects, f"the constructor {'; '.join(effects)}")
    check_quick(CONSTRUCTOR_S, build, "the constructor")


def _methods(protocol: type) -> list[str]:
    return sorted(
        n for n in vars(protocol) if not n.startswith("_") and callable(getattr(protocol, n))
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class Lifecycle(Generic[CaseT, C]):
    """A kind whose objects are built, started, used and closed; `rules` returns the rules shared by
    all such kinds.

    Attributes:
        subject: first half of the rules' ids.
        protocol: protocol of the built object.
        begin: name of its start method.
        start: starts the built object; raises NotApplicable if the case has no inputs for it.
        uses: one use of a method by its name; needs a started object. The first one is used most.
        abuses: calls with invalid arguments, which must be refused.
        besides: names of further methods without arguments, called while the process is watched.
        repeat: number of uses per round of the memory rule.
        ends: errors by which many uses may come to an end, such as an episode's.
        renew: begins anew after one of them.
    """

    subject: str
    protocol: type[object]
    begin: str
    start: Callable[[CaseT, C], None]
    uses: Mapping[str, Callable[[CaseT, C], object]]
    abuses: Sequence[Callable[[CaseT, C], object]] = ()
    besides: Sequence[str] = ()
    repeat: int = 20
    ends: tuple[type[Exception], ...] = ()
    renew: Callable[[C], object] = lambda subject: None

    @contextmanager
    def running(self, case: CaseT, build: Callable[[], C] | None = None) -> Iterator[C]:
        """Build and start the object; close it at the end."""
        make = attempt(case, case.prepare) if build is None else build
        with started(case, make, lambda subject: self.start(case, subject)) as subject:
            yield subject

    def built(self, case: CaseT) -> C:
        """Build the object without starting it."""
        subject: C = bounded(attempt(case, attempt(case, case.prepare)), case.limits_s)
        return subject

    def rules(self, *, without: Collection[str] = ()) -> tuple[Rule[CaseT], ...]:
        """The shared rules, without those that the kind defines itself."""
        return tuple(rule for rule in self._rules() if rule.id.partition("/")[2] not in without)

    def _rules(self) -> tuple[Rule[CaseT], ...]:
        source = f"{self.protocol.__module__}.{self.protocol.__name__}"

        def rule(
            name: str, text: str, check: Callable[[CaseT], None], where: str = ""
        ) -> Rule[CaseT]:
            return Rule(id=f"{self.subject}/{name}", text=text, source=source + where, check=check)

        begin = self.begin
        return (
            rule(
                "protocol",
                f"It has the methods of {self.protocol.__name__}.",
                lambda case: check_protocol(case, self.protocol),
            ),
            rule("constructor-pure", PURE, check_pure_constructor),
            rule(
                "options-read",
                OPTIONS_READ,
                self._check_options,
            ),
            rule(
                f"close-before-{begin}",
                f"`close` may be called twice and before `{begin}`.",
                self._check_close_first,
                ".close",
            ),
            rule(
                "close-releases",
                f"After `{begin}`, `close` may be called twice and leaves no thread, process or "
                "open file behind.",
                self._check_release,
                ".close",
            ),
            rule(
                f"second-{begin}-safe",
                f"A second `{begin}` changes nothing or raises StateError; one `close` releases "
                f"everything.",
                self._check_second_start,
                f".{begin}",
            ),
            rule(
                f"{begin}-after-close",
                f"After `close`, `{begin}` works again or is refused.",
                self._check_restart,
                f".{begin}",
            ),
            rule(
                "memory-bounded",
                f"Memory and open files do not grow with each `{self._name}`.",
                self._check_memory,
                f".{self._name}",
            ),
            rule("process-left-alone", ALONE, self._check_process),
            rule(
                "quiet",
                "It does not warn, log a warning or write to standard error with every call.",
                self._check_quiet,
            ),
            rule(
                "any-thread",
                f"After `{begin}` in one thread its methods work in another, as the modules call "
                "them.",
                self._check_any_thread,
            ),
            rule(
                "errors-readable",
                "Its error messages are short and contain no secret from options or environment.",
                self._check_errors,
            ),
            rule(
                "missing-file-refused",
                "An option that names a missing file leads to an error of roboneuron.errors, "
                "or to none.",
                self._check_missing_files,
                f".{begin}",
            ),
            *(
                rule(
                    f"{name}-before-{begin}-refused",
                    f"`{name}` before `{begin}` is a StateError.",
                    lambda case, name=name: self._check_use_first(case, name),  # type: ignore[misc]
                    f".{name}",
                )
                for name in self.uses
            ),
            *(
                rule(
                    f"{name}-after-close-refused",
                    f"`{name}` after `close` is a StateError.",
                    lambda case, name=name: self._check_use_last(case, name),  # type: ignore[misc]
                    f".{name}",
                )
                for name in self.uses
            ),
        )

    def _use(self, case: CaseT, subject: C) -> object:
        return next(iter(self.uses.values()))(case, subject)

    def _check_options(self, case: CaseT) -> None:
        def use(build: Callable[[], C]) -> None:
            with self.running(case, build) as subject:
                for one in self.uses.values():
                    with suppress(NotApplicable):  # such as joint commands to a base
                        one(case, subject)

        check_options_read(case, use)

    def _check_close_first(self, case: CaseT) -> None:
        subject = self.built(case)
        subject.close()
        subject.close()

    def _check_release(self, case: CaseT) -> None:
        def run() -> C:
            with self.running(case) as subject:
                self._use_all(case, subject)
            subject.close()
            return subject

        check_releases(run, "close()")

    def _use_all(self, case: CaseT, subject: C) -> None:
        for one in self.uses.values():
            with suppress(NotApplicable, RoboNeuronError):  # other rules check whether it works
                one(case, subject)

    def _check_second_start(self, case: CaseT) -> None:
        before = running()
        with self.running(case) as subject:
            try:
                self.start(case, subject)
            except StateError:
                pass
            except RoboNeuronError as error:
                what = f"a second {self.begin}() raised {type(error).__name__}: {error}"
                raise Violation(f"{what}; expected nothing, or a StateError") from error
            self._use(case, subject)
        check_released(before, f"close() after a second {self.begin}()")
        expect_refusal(lambda: self._use(case, subject), f"{self._name} after close", StateError)

    def _check_restart(self, case: CaseT) -> None:
        with self.running(case) as subject:
            pass
        try:
            self.start(case, subject)
        except RoboNeuronError as refusal:
            raise NotApplicable(f"it is refused: {refusal}") from refusal
        try:
            self._use(case, subject)
        finally:
            subject.close()

    def _check_process(self, case: CaseT) -> None:
        attempt(case, case.prepare)  # imports, which change the process once, are not judged

        def run() -> None:
            with self.running(case) as subject:
                self._use_all(case, subject)
                for name in self.besides:
                    getattr(subject, name)()

        changes = find_changes(run)
        require(not changes, f"it {'; '.join(changes)}")

    def _check_quiet(self, case: CaseT) -> None:
        with self.running(case) as subject:
            for name, one in self.uses.items():
                check_quiet(lambda one=one: one(case, subject), name)  # type: ignore[misc]

    def _check_any_thread(self, case: CaseT) -> None:
        limit_s = max((CALL_LIMIT_S, *case.limits_s.values()))
        with self.running(case) as subject:
            for name, one in self.uses.items():
                try:
                    one(case, subject)
                except (NotApplicable, RoboNeuronError):  # judged by other rules
                    continue
                try:
                    within(limit_s, lambda one=one: one(case, subject), name)  # type: ignore[misc]
                except self.ends:
                    continue
                except Violation:
                    raise
                except Exception as error:
                    told = f"{name} raised {type(error).__name__}: {error}"
                    raise Violation(f"in another thread than {self.begin}() {told}") from error

    def _check_missing_files(self, case: CaseT) -> None:
        def use(changed: Case[Spec]) -> None:
            with self.running(changed) as subject:  # type: ignore[arg-type]
                self._use(changed, subject)  # type: ignore[arg-type]

        check_missing_files(case, use)

    def _check_errors(self, case: CaseT) -> None:
        """Set every option and variable that may hold a secret to a known one, and search all
        errors for it.
        """
        hidden = dict.fromkeys(secret_options(case), SECRET)
        errors: list[BaseException] = []

        def provoke(call: Callable[[], object]) -> None:
            try:
                call()
            except NotApplicable:
                return
            except Exception as error:  # other rules check whether it is the right error
                errors.append(error)

        with secrets():
            try:
                subject = self.built(case.with_options(hidden))
            except RoboNeuronError:  # an option refuses the value
                subject = self.built(case)
            try:
                provoke(lambda: self._use(case, subject))
                provoke(lambda: self.start(case, subject))
                for abuse in (*self.abuses, *self.uses.values()):
                    provoke(lambda abuse=abuse: abuse(case, subject))  # type: ignore[misc]
            finally:
                subject.close()
            provoke(lambda: self._use(case, subject))
        for error in errors:
            check_error(error)

    def _use_on(self, case: CaseT, subject: C) -> object:
        """Use it once more in a long row of uses."""
        try:
            return self._use(case, subject)
        except self.ends:
            self.renew(subject)
            return self._use(case, subject)

    def _check_memory(self, case: CaseT) -> None:
        build = attempt(case, lambda: case.prepare(MemoryTopics(history=1)))
        with self.running(case, build) as subject:
            check_memory(lambda: self._use_on(case, subject), self._name, count=self.repeat)

    def _check_use_first(self, case: CaseT, name: str) -> None:
        subject = self.built(case)
        try:
            expect_refusal(
                lambda: self.uses[name](case, subject), f"{name} before {self.begin}", StateError
            )
        finally:
            subject.close()

    def _check_use_last(self, case: CaseT, name: str) -> None:
        with self.running(case) as subject:
            pass
        expect_refusal(lambda: self.uses[name](case, subject), f"{name} after close", StateError)

    @property
    def _name(self) -> str:
        return next(iter(self.uses))
