"""What the pages of "Your agent" type is taken: their configuration by core and the features, their
commands by the parsers.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from rn_standard.console.parsers import whole_parser
from roboneuron.config import parse_config
from roboneuron.planning import check_configuration
from roboneuron.plugins.discovery import discover

DOCS = Path(__file__).parents[1] / "docs"
PAGES = (
    *("agents", "tasks", "sight", "direct-path", "http", "view", "phone", "teleoperation"),
    *("metrics", "interfaces"),
)
ROBOT = '[robot]\nname = "fr3"\n'


def blocks(page: str, languages: str) -> list[str]:
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    return re.findall(rf"```(?:{languages})\n(.*?)```", text, re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_configurations_are_accepted(page: str) -> None:
    registry = discover()
    for text in blocks(page, "toml"):
        whole = text if "[robot]" in text else ROBOT + text
        check_configuration(parse_config(whole, registry=registry), registry)


@pytest.mark.parametrize("page", PAGES)
def test_commands_are_taken_by_the_parsers(page: str) -> None:
    typed = "\n".join(blocks(page, "bash|console")).replace("\\\n", "")
    for line in re.findall(r"^(?:\$ )?(?:[A-Z_]+=\S+ )*roboneuron (.*)$", typed, re.MULTILINE):
        words = shlex.split(line, comments=True)
        assert whole_parser().parse_args(words).command == words[0]
