"""Mutation tests of the safety code: does a test fail if one operation of it changes?

    make test-mutations                                 # every part; resumes
    make test-mutations ARGS="gate --only estop"        # tries those with "estop" in the name again
    make test-mutations ARGS="direct-path --list"       # known results, with the survivors

mutmut makes the mutants, selects the tests by the functions they call and forks for each mutant;
tools/mutation_operators.py defines the mutants. A mutant times out if it computes for 12 s plus six
times the normal duration of its tests, or sleeps for 20 s, so a busy machine kills none. Survivors
must be listed in tools/mutation_survivors.toml with a reason: `equivalent` if no test could detect
it, or `accepted`, which still counts as survived. The lane fails for unlisted survivors, and for a
part below 95 % of the mutants that are not equivalent.

Results are kept in out/mutations/PART. A changed function is tried again; after a change of a test
everything that was not killed is; `--fresh` tries everything again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import sys
import traceback
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import mutation_operators
from mutation_parts import PARTS, ROOT, Part
from mutation_results import print_report, read_mutants

from rn_testing.domain import free_ros_domain

OUT = ROOT / "out" / "mutations"
NO_TESTS = 33
"""Exit code of mutmut for a mutant of a function that no test calls."""
CONFTESTS = ("roboneuron-core/tests/conftest.py", "tests/conftest.py", "tests/safety/conftest.py")
MARKERS = "not ros and not timing and not slow and not gpu and not hardware and not release"
LEFT_OUT = (
    # Contract tests read the sources, which contain mutants here.
    "*_keep*_contract.py",
    # Tests of modules that no part mutates, some of which wait by the clock.
    *(f"tests/modules/{name}/test_*.py" for name in ("execution", "inference", "perception")),
    # Slow tests (seconds each), next to faster ones of the same subject.
    "test_no_permitted_motion_penetrates_anything",
    "test_nothing_that_passes_meets_a_zone",
    "test_a_reset_by_another_process_races_with_nobody_who_looks",
    "test_what_is_written_is_read",
    "test_a_way_that_would_take_too_long_to_judge_is_refused",
)
"""Files and tests that are not run."""


def main() -> int:
    """Run the parts named in the arguments, and print figures; return 1 if the lane fails."""
    arguments = _parse_arguments()
    is_good = True
    for name in arguments.parts or PARTS:
        part, work = PARTS[name], OUT / name
        if arguments.list is False:
            _run_in_a_fork(part, work, arguments)
        is_good &= print_report(name, list(read_mutants(part, work)))
    return 0 if is_good else 1


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"one or more of {', '.join(PARTS)}; default: all"
    )
    parser.add_argument(
        "--only",
        nargs="+",
        default=[],
        metavar="NAME",
        help="try again the mutants with one of these in file, class or function",
    )
    parser.add_argument("--jobs", type=int, default=1, help="mutants at a time; default: 1")
    parser.add_argument("--fresh", action="store_true", help="forget what is known")
    parser.add_argument("--list", action="store_true", help="only print what is known")
    arguments = parser.parse_args()
    for name in arguments.parts:
        if name not in PARTS:
            parser.error(f"no part {name!r}; there are {', '.join(PARTS)}")
    return arguments


def _run_in_a_fork(part: Part, work: Path, arguments: argparse.Namespace) -> None:
    """Run a part in its own process, because mutmut keeps its state in its modules and changes the
    directory.
    """
    process = os.fork()
    if process:
        status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        if status:
            sys.exit(
                f"The mutants could not be tried (exit status {status}); see {OUT}/{work.name}.log."
            )
        return
    status = 1
    try:
        if not sys.stdout.isatty():  # because mutmut draws a progress display
            OUT.mkdir(parents=True, exist_ok=True)
            with (OUT / f"{work.name}.log").open("w") as log:
                os.dup2(log.fileno(), sys.stdout.fileno())
        _prepare(part, work, is_fresh=arguments.fresh)
        os.chdir(work)
        import mutation_runs
        from mutmut.__main__ import _run  # reads the settings of the directory where it is imported

        mutation_operators.install()
        mutation_runs.install(part.tests, goes_on=not arguments.only)
        only = tuple(f"*{name}*" for name in arguments.only)
        _run(only or part.patterns(), 1)
        status = 0
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(status)


def _prepare(part: Part, work: Path, *, is_fresh: bool) -> None:
    """Prepare mutmut's folder: src/PACKAGE, which it copies to mutants/ with the mutants, and the
    tests.
    """
    rules = f"{metadata.version('mutmut')} {_digest([Path(mutation_operators.__file__)])}"
    if is_fresh or _read_text(work / "rules") != rules:
        shutil.rmtree(work, ignore_errors=True)
    sources = ROOT / part.package
    tests = [path for name in part.tests for path in _files(ROOT / name)]
    for path in sorted(sources.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            inside = Path("src") / sources.name / path.relative_to(sources)
            is_changed = _write_changed(work / inside, _source(part, path))
            copied = work / "mutants" / inside
            if path.suffix != ".py" and copied.exists():  # mutmut copies it only once
                _write_changed(copied, path.read_bytes())
            meta = work / "mutants" / inside.with_name(f"{path.name}.meta")
            if _is_mutated(part, path) and (is_changed or not meta.exists()):
                # so that mutmut detects which tests call a new function
                (work / inside).touch()
                (work / "mutants" / "mutmut-stats.json").unlink(missing_ok=True)
                _forget(meta, lambda code: code == NO_TESTS)
    mutants = work / "mutants"
    for folder in (*part.tests, *CONFTESTS):
        target = mutants / folder
        if (ROOT / folder).is_file():
            _write_changed(target, (ROOT / folder).read_bytes())
        else:
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(ROOT / folder, target, ignore=shutil.ignore_patterns("__pycache__"))
    settings_text = (ROOT / "pyproject.toml").read_text("utf-8") + _settings(part)
    _write_changed(work / "pyproject.toml", settings_text.encode())
    _forget_survivors(part, work, _digest([*tests, *(ROOT / name for name in CONFTESTS)]))
    (work / "rules").write_text(rules, "utf-8")
    # so that processes started by a test have the mutant too
    os.environ["PYTHONPATH"] = str(mutants / "src")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("ROS_DOMAIN_ID", str(free_ros_domain()))
    os.environ["ROBONEURON_RECORDER"] = "off"


def _settings(part: Part) -> str:
    package = Path(part.package).name
    folders = [name for name in LEFT_OUT if name.endswith(".py")]
    words = [name for name in LEFT_OUT if not name.endswith(".py")]
    settings_of_mutmut = {
        "source_paths": ["src"],
        "only_mutate": [f"src/{package}/{file}" for file in part.files],
        "pytest_add_cli_args_test_selection": list(part.tests),
        "pytest_add_cli_args": [
            *("-m", MARKERS, "-k", " and ".join(f"not {word}" for word in words)),
            *(f"--ignore-glob=*/{name}" for name in folders),
            *("-p", "mutation_plugin", "-p", "no:cacheprovider"),
            # pytest starts again in every process
            *("-W", "ignore::pytest.PytestAssertRewriteWarning"),
        ],
        "process_isolation": "forkserver",
        "timeout_constant": 2.0,
        "timeout_multiplier": 3.0,  # of wall-clock time; for CPU time mutmut allows twice that
        "on_dependency_change": "ignore",
        "use_git_change_detection": False,
    }
    lines = (f"{key} = {json.dumps(value)}" for key, value in settings_of_mutmut.items())
    return "\n[tool.mutmut]\n" + "\n".join(lines) + "\n"


def _is_mutated(part: Part, path: Path) -> bool:
    inside = path.relative_to(ROOT / part.package)
    return any(
        inside.match(pattern) and len(inside.parts) == len(Path(pattern).parts)
        for pattern in part.files
    )


def _source(part: Part, path: Path) -> bytes:
    if _is_mutated(part, path):
        return mutation_operators.unwrap_decorators(path.read_text("utf-8")).encode()
    return path.read_bytes()


def _forget_survivors(part: Part, work: Path, tests: str) -> None:
    """Have all mutants that were not killed tried again if a test has changed."""
    if _read_text(work / "tests") == tests:
        return
    (work / "mutants" / "mutmut-stats.json").unlink(missing_ok=True)
    for meta in (work / "mutants" / "src").rglob("*.py.meta"):
        _forget(meta, lambda code: code != 1)
    (work / "tests").write_text(tests, "utf-8")


def _forget(meta: Path, is_meant: Callable[[int | None], bool]) -> None:
    """Have mutants with a matching exit code tried again, using mutmut's result file."""
    if not meta.exists():
        return
    known = json.loads(meta.read_text("utf-8"))
    results = known["exit_code_by_key"]
    known["exit_code_by_key"] = {
        key: None if is_meant(code) else code for key, code in results.items()
    }
    meta.write_text(json.dumps(known), "utf-8")


def _files(place: Path) -> list[Path]:
    return sorted(place.rglob("*.py")) if place.is_dir() else [place]


def _write_changed(path: Path, content: bytes) -> bool:
    """Write a file unless it has this content, and return whether it did, because mutmut uses
    modification times.
    """
    if path.is_file() and path.read_bytes() == content:
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return True


def _read_text(path: Path) -> str:
    return path.read_text("utf-8") if path.is_file() else ""


def _digest(paths: list[Path]) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
