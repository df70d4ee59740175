"""Programs that answer for one interface after the other, each in a process of its own, so that an
interface with which they fail, end or never end is known, and the others have an answer.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from rn_interfaces.store import Name, parse_name

_TIMEOUT_S = 60.0
_EACH_S = 5.0
"""Time limit for each interface, which takes 0.1 s on an idle machine."""


def ask_each(module: str, argument: Path, names: Sequence[Name]) -> dict[Name, str]:
    """Run a module of Python for interfaces; return the reasons of those with which it fails.

    Args:
        module: gets the full names as lines of stdin, and writes [name, reason] as a line of JSON
            for each, in the same order; it may end after a failure.
        argument: its argument.
        names: the interfaces.
    """
    bad: dict[Name, str] = {}
    left = list(names)
    while left:
        answers, last = _run([module, str(argument)], left)
        bad |= {name: reason for name, reason in answers.items() if reason}
        left = [name for name in left if name not in answers]
        if left and not any(answers.values()):
            bad[left.pop(0)] = last
    return bad


def _run(module: list[str], names: Sequence[Name]) -> tuple[dict[Name, str], str]:
    """Answers, and why there is none for the next interface."""
    bound_s = _TIMEOUT_S + _EACH_S * len(names)
    try:
        ended = subprocess.run(
            [sys.executable, "-P", "-m", *module],
            input="\n".join(map(str, names)).encode(),
            capture_output=True,
            timeout=bound_s,
            check=False,
        )
        printed, lines = ended.stdout, ended.stderr.decode(errors="replace").splitlines()
        last = f"Python ended with {ended.returncode} ({' '.join(lines[-1:])[:200]})"
    except subprocess.TimeoutExpired as error:
        printed, last = error.stdout or b"", f"it takes more than {bound_s:g} s"
    found = printed.decode(errors="replace").splitlines(keepends=True)
    whole = [json.loads(line) for line in found if line.endswith("\n")]
    return {parse_name(name): reason for name, reason in whole}, last
