"""Trials of test files under one condition, and rows of the ledger about them."""

from __future__ import annotations

import ast
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

NOT_HERE = "not sourced and not peers and not gpu and not hardware and not slow and not release"
LANES = {
    "units": f"not ros and not exhaustive and {NOT_HERE}",
    "ros": f"ros and not timing and not exhaustive and {NOT_HERE}",
    "timing": f"ros and timing and {NOT_HERE}",
}
_WAITING = frozenset(
    (
        *("subprocess", "threading", "multiprocessing", "concurrent", "asyncio", "anyio", "socket"),
        *("time", "signal", "selectors", "http", "websockets", "rclpy", "psutil", "queue"),
    )
)
"""Modules of files that start processes or threads, wait or ask a clock."""
_WAITING_NAMES = frozenset(("Client", "Supervisor", "RosLink", "server_environment", "Agent"))
_NONE_SELECTED = 5
_BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent:\n    pass\n"


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """One run of pytest.

    Attributes:
        files: test files, relative to the root.
        lane: one of LANES.
        python: interpreter.
        busy: number of busy loops beside it.
        workers: number of workers; 1 for none of pytest-xdist.
        number: repetition; also decides the order of the tests.
    """

    files: tuple[str, ...]
    lane: str
    python: str
    busy: int
    workers: int
    number: int

    @property
    def condition(self) -> str:
        """The condition in words."""
        return f"{Path(self.python).name} busy={self.busy} workers={self.workers}"


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """Result of one trial.

    Attributes:
        trial: the trial.
        commit: of the tree.
        load: load of the machine at its end.
        took_s: duration.
        passed: number of passed tests.
        failed: the error's first line by id of the test.
        ended: why there are no results; empty if there are.
    """

    trial: Trial
    commit: str
    load: float
    took_s: float
    passed: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    ended: str = ""

    def to_line(self) -> str:
        """A line of the ledger."""
        return json.dumps(asdict(self)) + "\n"

    @classmethod
    def from_line(cls, line: str) -> Row:
        """Parse a line of the ledger. Raises ValueError if it is none."""
        try:
            facts = json.loads(line)
            trial = facts.pop("trial")
            trial["files"] = tuple(trial["files"])
            return cls(trial=Trial(**trial), **facts)
        except (TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"no row of a ledger: {error}") from error


def waits(text: str) -> bool:
    """True if a test file starts processes or threads, waits or asks a clock."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names = {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names = {(node.module or "").partition(".")[0], *(alias.name for alias in node.names)}
        elif isinstance(node, ast.Attribute) and node.attr in ("ros", "timing"):
            return True
        elif isinstance(node, ast.arg):
            names = {node.arg}
        else:
            continue
        if names & (_WAITING | _WAITING_NAMES) or "wait_until" in names or "holds_within" in names:
            return True
    return False


def run_trial(root: Path, trial: Trial, commit: str, limit_s: float) -> Row:
    """Run pytest in a process group of its own, which is killed after `limit_s`."""
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="flakes-") as folder:
        report = Path(folder) / "report.xml"
        command = [
            *(trial.python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--tb=short"),
            *("-m", LANES[trial.lane], "--shuffle", str(trial.number)),
            *("-o", "junit_family=xunit1", f"--junit-xml={report}"),
            *(("-n", str(trial.workers)) if trial.workers > 1 else ()),
            *trial.files,
        ]
        with busy_loops(trial.busy):
            code, said = _run(command, root, limit_s)
        results = _read_report(report)
    passed, failed = results if results is not None else (0, {})
    ended = ""
    if code not in (0, 1, _NONE_SELECTED) or results is None:
        last = said.strip().splitlines()[-1:] or ["no output"]
        ended = f"{'not ended in time' if code is None else f'status {code}'}: {last[0][:300]}"
    return Row(
        trial=trial,
        commit=commit,
        load=round(os.getloadavg()[0], 1),
        took_s=round(time.monotonic() - begun_s, 1),
        passed=passed,
        failed=failed,
        ended=ended,
    )


def _run(command: Sequence[str], root: Path, limit_s: float) -> tuple[int | None, str]:
    """Exit status and output; None for the status if it was killed."""
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            command, cwd=root, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        code: int | None = None
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            pass
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        output.seek(0)
        return code, output.read().decode(errors="replace")


def _read_report(path: Path) -> tuple[int, dict[str, str]] | None:
    """Number of passed tests and errors of failed ones; None without a whole report."""
    try:
        cases = list(ET.parse(path).getroot().iter("testcase"))
    except (OSError, ET.ParseError):
        return None
    failed: dict[str, str] = {}
    passed = 0
    for case in cases:
        problem = case.find("failure")
        problem = case.find("error") if problem is None else problem
        if problem is not None:
            failed[_id_of(case)] = _first_line(problem)
        elif case.find("skipped") is None:
            passed += 1
    return passed, failed


def _id_of(case: ET.Element) -> str:
    file = case.get("file") or case.get("classname", "").replace(".", "/")
    module = file.removesuffix(".py").replace("/", ".")
    within = case.get("classname", "").removeprefix(module).strip(".")
    return "::".join(part for part in (file, within, case.get("name", "")) if part)


def _first_line(problem: ET.Element) -> str:
    text = (problem.text or "").splitlines()
    errors = [line.removeprefix("E").strip() for line in text if line.startswith("E  ")]
    # the message of a collection or of a fixture only says which it was
    lines = [*errors, problem.get("message") or "", *text]
    line = next((line for line in lines if line.strip()), "no message")
    return re.sub(r"\s+", " ", line.splitlines()[0])[:300]


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Run processes that compute all the time; they end with this one, too."""
    loops = [subprocess.Popen([sys.executable, "-c", _BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
