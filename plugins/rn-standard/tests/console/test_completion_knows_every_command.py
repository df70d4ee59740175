"""The scripts are valid in their shells, hold every command and option, and complete in bash
without Python.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rn_standard.console.completion import SHELLS
from rn_standard.console.parsers import whole_parser
from roboneuron.cli.listing import all_commands
from roboneuron.cli.main import main
from roboneuron.plugins.discovery import discover


@pytest.fixture(scope="module")
def scripts() -> dict[str, str]:
    found = {}
    for shell in SHELLS:
        words = [sys.executable, "-m", "roboneuron.cli.main", "completion", shell]
        found[shell] = subprocess.run(
            words, capture_output=True, text=True, check=True, timeout=60
        ).stdout
    return found


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("shell", SHELLS)
def test_commands_of_core_and_of_plugins_are_in_it(scripts: dict[str, str], shell: str) -> None:
    for command in all_commands(discover()):
        for word in command.words.split():
            assert word in scripts[shell]
    assert "token-variable" in scripts[shell]


@pytest.mark.parametrize("shell", SHELLS)
def test_the_shell_can_read_it(scripts: dict[str, str], shell: str, tmp_path: Path) -> None:
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    path = tmp_path / "script"
    path.write_text(scripts[shell])
    subprocess.run([program, "-n", str(path)], check=True, timeout=60)


COMPLETE = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
$(complete -p roboneuron | sed -E 's/.*-F ([^ ]+).*/\\1/') roboneuron "${COMP_WORDS[COMP_CWORD]}" ""
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["st"], {"status"}),
        (["logs", "per"], {"perception"}),
        (["completion", ""], set(SHELLS)),
        (["status", "--w"], {"--watch"}),
        (["run", "--max-"], {"--max-s", "--max-attempts"}),
        (["config", "sh"], {"show"}),
        (["plugins", ""], {"list", "show", "check", "new"}),
        (["ros", ""], {"describe", "learn"}),
        (["robot", "cameras", ""], {"calibrate"}),
    ],
)
def test_bash_completes_words(
    scripts: dict[str, str], tmp_path: Path, words: list[str], expected: set[str]
) -> None:
    path = tmp_path / "script"
    path.write_text(scripts["bash"])
    done = subprocess.run(
        ["bash", "--norc", "-c", COMPLETE, "bash", str(path), "roboneuron", *words],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        env={"PATH": "/usr/bin:/bin"},  # no Python of this environment, no roboneuron
    )
    assert {word.strip() for word in done.stdout.split()} >= expected


def test_files_are_completed_where_files_are_meant() -> None:
    commands = next(a for a in whole_parser()._actions if isinstance(a, argparse._SubParsersAction))
    options = {o: a for a in commands.choices["status"]._actions for o in a.option_strings}
    assert options["--config"].complete["bash"]  # type: ignore[attr-defined]
    assert not hasattr(options["--url"], "complete")


def test_another_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["completion", "nonsense"])
    assert "bash" in capsys.readouterr().err
