"""docs/command-line.md lists the existing commands and options."""

from __future__ import annotations

import re
from pathlib import Path

from rn_standard.console.parsers import whole_parser
from rn_standard.console.reference import with_reference
from rn_standard.console.story import RunStatus
from roboneuron.plugins.availability import known_names


def test_its_reference_is_current(root: Path) -> None:
    page = (root / "docs" / "command-line.md").read_text(encoding="utf-8")
    hint = (
        "run: python -m rn_standard.console.reference docs/command-line.md (with all packages "
        "installed)"
    )
    assert with_reference(page) == page, hint


def test_commands_in_its_prose_are_taken_by_the_parsers(root: Path) -> None:
    page = (root / "docs" / "command-line.md").read_text(encoding="utf-8").partition("<!--")[0]
    blocks = "\n".join(re.findall(r"```(?:bash|console)\n(.*?)```", page, re.DOTALL))
    used = re.findall(r'^(?:\$ )?roboneuron ((?:"[^"]*"|[^>#"\n])*)', blocks, re.MULTILINE)
    assert len(used) >= 6
    for line in used:
        words = [word.strip('"') for word in re.findall(r'"[^"]*"|\S+', line)]
        assert whole_parser().parse_args(words).command == words[0]


def test_its_exit_statuses_are_those_of_run(root: Path) -> None:
    page = (root / "docs" / "command-line.md").read_text(encoding="utf-8")
    table = page.partition("| exit status |")[2].partition("\n\n")[0]
    listed = {int(number) for number in re.findall(r"^\| (\d+) \|", table, re.MULTILINE)}
    assert listed == {int(status) for status in RunStatus} | {2}


def test_its_prose_names_the_packages_of_commands_that_requirements_lack(root: Path) -> None:
    page = (root / "docs" / "command-line.md").read_text(encoding="utf-8").partition("\n## ")[0]
    listed = (root / "requirements.txt").read_text(encoding="utf-8").splitlines()
    groups = ("plugins", "policy", "robot")
    others = {
        name.replace("-", " ", 1) if name.partition("-")[0] in groups else name: package
        for name, package in known_names("command").items()
        if f"./plugins/{package}" not in listed
    }
    prose = " ".join(page.split())
    packages = re.findall(r"((?:`[a-z -]+`(?:,| and)? ?)+)\((rn-[a-z0-9-]+)\)", prose)
    told = {
        name: package for names, package in packages for name in re.findall(r"`([a-z -]+)`", names)
    }
    assert told == others
