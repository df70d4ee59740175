"""The ledger: an append-only file with one line of JSON per finished episode; each line is synced
to disk before it counts.

A line truncated by a crash is removed when the ledger is opened again, and its episode is run
again.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Generic, Literal, Protocol, Self, TypeVar

from rn_eval.plan import EvalPlan
from rn_eval.record import EpisodeRecord
from rn_eval.versions import changed_versions
from roboneuron import (
    ConfigurationError,
    ForeignDataError,
    StateError,
    foreign,
)

_MOST_BYTES = 1 << 24
FILE_NAME = "episodes.jsonl"
PLAN_NAME = "plan.json"
STRIPS = "strips"


class LedgerKey(Protocol):
    """Hashable identity of an episode within a run."""

    @property
    def slug(self) -> str:
        """Name for files."""
        ...

    def __hash__(self) -> int: ...


class LedgerOutcome(Protocol):
    """Result of an episode."""

    @property
    def status(self) -> Literal["success", "failure", "error"]:
        """An episode with "error" may be run again."""
        ...


class LedgerRecord(Protocol):
    """A line of a ledger: a pydantic model with these fields."""

    @property
    def key(self) -> LedgerKey: ...
    @property
    def outcome(self) -> LedgerOutcome: ...
    @property
    def versions(self) -> dict[str, str]: ...
    @property
    def host(self) -> str: ...
    @classmethod
    def model_validate_json(cls, json_data: str, /) -> Self: ...
    def model_copy(self, *, update: dict[str, object]) -> Self: ...
    def model_dump_json(self) -> str: ...


class LedgerPlan(Protocol):
    """The plan of a ledger: a pydantic model with these fields."""

    @property
    def versions(self) -> dict[str, str]: ...
    @property
    def later_versions(self) -> tuple[dict[str, str], ...]: ...
    @property
    def identity(self) -> dict[str, object]: ...
    @property
    def parts(self) -> dict[str, str]:
        """Definitions by name; others may be added, but a name in two plans means the same."""
        ...

    def continued_by(self, now: Self, /) -> Self:
        """Return the plan to store when `now` continues this one."""
        ...

    @classmethod
    def model_validate_json(cls, json_data: str, /) -> Self: ...
    def model_copy(self, *, update: dict[str, object]) -> Self: ...
    def model_dump_json(self, *, indent: int) -> str: ...


PlanT = TypeVar("PlanT", bound=LedgerPlan)
RecordT = TypeVar("RecordT", bound=LedgerRecord)


def read_plan_of(directory: Path, kind: type[PlanT]) -> PlanT:
    """Read the plan of a run as the model `kind`.

    Raises:
        ConfigurationError: there is none, or it is damaged.
    """
    path = directory / PLAN_NAME
    try:
        text = foreign.read_bytes(path, most_bytes=_MOST_BYTES)
        return foreign.decode_model(kind, text, path.name, most_bytes=_MOST_BYTES)
    except (OSError, ForeignDataError) as error:
        raise ConfigurationError(f"{path} holds no plan of an evaluation: {error}.") from error


def read_plan(directory: Path) -> EvalPlan:
    """Read the plan of a policy evaluation. Raises as `read_plan_of`."""
    return read_plan_of(directory, EvalPlan)


def read_records_of(directory: Path, kind: type[RecordT]) -> list[RecordT]:
    """Read all finished episodes, oldest first, without disturbing a run. A truncated last line is
    left out.

    A crashed episode may occur again later: the last record counts.

    Raises:
        ConfigurationError: a line before the last one is damaged, or an episode occurs twice.
    """
    path = directory / FILE_NAME
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return []
    lines = data[: data.rfind(b"\n") + 1].splitlines()
    records: dict[LedgerKey, RecordT] = {}
    for number, line in enumerate(lines, 1):
        try:
            record = foreign.decode_model(kind, line, "the line")
        except ForeignDataError as error:
            raise ConfigurationError(f"{path}:{number} is damaged: {error}.") from error
        before = records.pop(record.key, None)
        if before is not None and before.outcome.status != "error":
            raise ConfigurationError(f"{path}:{number} repeats the episode {record.key.slug}.")
        records[record.key] = record
    return list(records.values())


def read_records(directory: Path) -> list[EpisodeRecord]:
    """Read the episodes of a policy evaluation; as `read_records_of`."""
    return read_records_of(directory, EpisodeRecord)


class RunLedger(Generic[PlanT, RecordT]):
    """The ledger of one run, locked by one process at a time. Use it as a context manager."""

    def __init__(
        self,
        directory: Path,
        plan: type[PlanT],
        record: type[RecordT],
        *,
        other_versions: bool = False,
    ) -> None:
        """Args:
        directory: directory of the ledger.
        plan, record: models of the plan and of the lines.
        other_versions: accept other package versions than at the start of the run; the plan and
            each line record them.
        """
        self.directory = directory
        self._plan_kind, self._record_kind = plan, record
        self.plan: PlanT | None = None
        """Plan in the folder once open, with the package versions at the start of the run."""
        self._other_versions = other_versions
        self.records: dict[LedgerKey, RecordT] = {}
        self.cut_bytes = 0
        self._file = -1

    def open(self, plan: PlanT) -> None:
        """Start or continue the run.

        Raises:
            StateError: another process runs it, or the folder cannot be written.
            ConfigurationError: the folder has a run with another plan or other versions, or the
                ledger is damaged.
        """
        path = self.directory / FILE_NAME
        with _told(path):
            self.directory.mkdir(parents=True, exist_ok=True)
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(file)
            raise StateError(f"Another process runs the evaluation in {self.directory}.") from error
        self._file = file
        try:
            self._continue(plan)
        except BaseException:
            self.close()
            raise

    def _continue(self, plan: PlanT) -> None:
        if (self.directory / PLAN_NAME).exists():
            before = read_plan_of(self.directory, self._plan_kind)
            _check_same(before, plan, self.directory)
            plan = before.continued_by(self._with_versions(before, plan))
        _write_durably(self.directory / PLAN_NAME, plan.model_dump_json(indent=1).encode())
        self.plan = plan
        found = read_records_of(self.directory, self._record_kind)
        self.records = {record.key: record for record in found}
        data = (self.directory / FILE_NAME).read_bytes()
        whole = data.rfind(b"\n") + 1
        self.cut_bytes = len(data) - whole
        if self.cut_bytes:
            with _told(self.directory / FILE_NAME):
                os.ftruncate(self._file, whole)
                os.fsync(self._file)

    def _with_versions(self, before: PlanT, now: PlanT) -> PlanT:
        """The plan with the versions at the start of the run; differing current ones are added to
        the later versions.

        Raises:
            ConfigurationError: they differ, and this was not allowed.
        """
        begun, later = before.versions, before.later_versions
        changed = changed_versions(begun, now.versions)
        if changed and not self._other_versions:
            raise ConfigurationError(
                f"{self.directory} was begun under other versions: {', '.join(changed)}.",
                hint="Install those, choose another --out, or mix them with --other-versions: "
                "each line has its own.",
            )
        if changed and now.versions not in later:
            later = (*later, now.versions)
        return now.model_copy(
            update={"versions": {**now.versions, **begun}, "later_versions": later}
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def add(self, record: RecordT, strip: bytes | None = None) -> None:
        """Write an episode to disk; when this returns, it survives a crash of the machine.

        Raises:
            StateError: it exists already and did not crash, or it cannot be written; the ledger is
                then unchanged.
            ConfigurationError: a worker ran it with other versions than at the start of the run.
        """
        assert self.plan is not None
        before = self.records.get(record.key)
        if before is not None and before.outcome.status != "error":
            raise StateError(f"The episode {record.key.slug} is in the ledger already.")
        changed = changed_versions(self.plan.versions, record.versions)
        if changed and not self._other_versions:
            raise ConfigurationError(
                f"The worker on {record.host} has other versions than the run was begun with: "
                f"{', '.join(changed)}.",
                hint="Install the same packages on every machine, or mix them with "
                "--other-versions.",
            )
        if strip is not None:
            name = f"{record.key.slug}.png"
            with _told(self.directory / STRIPS):
                (self.directory / STRIPS).mkdir(exist_ok=True)
            _write_durably(self.directory / STRIPS / name, strip)
            record = record.model_copy(update={"strip": name})
        line = record.model_dump_json().encode() + b"\n"
        begun = os.fstat(self._file).st_size
        with _told(self.directory / FILE_NAME):
            try:
                if os.write(self._file, line) != len(line):
                    raise OSError(
                        errno.ENOSPC, "only a part of the line was written; the disk is full"
                    )
                os.fsync(self._file)
            except OSError:
                os.ftruncate(self._file, begun)
                raise
        self.records[record.key] = record

    def close(self) -> None:
        """Release the lock; may be called twice."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


class Ledger(RunLedger[EvalPlan, EpisodeRecord]):
    """The ledger of a policy evaluation."""

    def __init__(self, directory: Path, *, other_versions: bool = False) -> None:
        """Args as in `RunLedger`."""
        super().__init__(directory, EvalPlan, EpisodeRecord, other_versions=other_versions)


def _check_same(old: LedgerPlan, new: LedgerPlan, directory: Path) -> None:
    before, now = old.identity, new.identity
    changed = [name for name in before if before[name] != now[name]]
    if changed:
        name = changed[0]
        raise ConfigurationError(
            f"{directory} holds a run with another {name}: {json.dumps(before[name])[:200]}, now "
            f"{json.dumps(now[name])[:200]}.",
            hint="Choose another --out, or give what that run was begun with.",
        )
    known, given = old.parts, new.parts
    other = [name for name in known if name in given and known[name] != given[name]]
    if other:
        name = other[0]
        raise ConfigurationError(
            f"{directory} holds episodes of another {name}: {_shown(known[name])}, now "
            f"{_shown(given[name])}.",
            hint="Give the new one another name, choose another --out, or give what the run was "
            "begun with.",
        )


def _shown(definition: str) -> str:
    """A definition for a message, whole because the difference may be at its end; "" stands for
    an installed part.
    """
    return json.dumps(definition) if definition else "the installed one"


def _write_durably(path: Path, data: bytes) -> None:
    """Replace the file atomically, so that a crash or a full disk leaves the old or the new one.
    Raises StateError.
    """
    temporary = path.with_name(f".{path.name}.new")
    with _told(path):
        try:
            with temporary.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except OSError:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Convert a write error into one sentence that names the file and the remedy. Raises
    StateError.
    """
    try:
        yield
    except OSError as error:
        raise StateError(
            f"{path} cannot be written: {error.strerror or error}.",
            hint="Free space on that disk or mend the permissions. Finished episodes are kept; "
            "the same command "
            "runs the others.",
        ) from error
