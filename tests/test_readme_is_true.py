"""The README's instructions for a new user work: client configuration blocks, commands, links."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import anyio
import pytest
from mcp import Client, StdioServerParameters

from roboneuron.cli.listing import all_commands
from roboneuron.config import default_text
from roboneuron.plugins.discovery import discover


def blocks(root: Path, language: str) -> list[str]:
    return re.findall(
        rf"```{language}\n(.*?)```", (root / "README.md").read_text(encoding="utf-8"), re.DOTALL
    )


@pytest.mark.ros
@pytest.mark.parametrize(
    "is_own",
    [False, pytest.param(True, marks=pytest.mark.exhaustive)],
    ids=["as printed", "own configuration"],
)
def test_client_configuration_block_launches_the_server(
    root: Path, environment: dict[str, str], tmp_path: Path, is_own: bool
) -> None:
    entry = json.loads(blocks(root, "json")[0])["mcpServers"]["roboneuron"]
    arguments = entry["args"]
    if is_own:
        (found,) = re.findall(r'`"args": (.*?)`', (root / "README.md").read_text(encoding="utf-8"))
        arguments = json.loads(found)
    (tmp_path / "roboneuron.toml").write_text(default_text(), encoding="utf-8")
    parameters = StdioServerParameters(
        command=entry["command"], args=arguments, env=environment, cwd=tmp_path
    )

    async def tools() -> set[str]:
        async with Client(parameters) as client:
            return {tool.name for tool in (await client.list_tools()).tools}

    assert {"start_robot", "start_inference", "get_status", "emergency_stop"} <= anyio.run(tools)


def test_every_command_in_the_readme_exists(root: Path) -> None:
    text = (root / "README.md").read_text(encoding="utf-8")
    used = set(re.findall(r"(?:^|`)roboneuron ([a-z-]+)", text, re.MULTILINE))
    assert used
    assert used <= {command.words.split()[0] for command in all_commands(discover())}
    targets = set(re.findall(r"make ([a-z0-9-]+)", " ".join(blocks(root, "bash"))))
    assert targets <= make_targets(root)


def make_targets(root: Path) -> set[str]:
    told = subprocess.run(
        ["make", "--no-print-directory", "help"],
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    return {line.split()[0] for line in told.stdout.splitlines() if line}


def test_pages_name_targets_that_there_are(root: Path) -> None:
    """Targets of the Makefile, sessions of noxfile.py, and environments."""
    pages = [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").rglob("*.md"))]
    text = " ".join(page.read_text(encoding="utf-8") for page in pages)
    named = set(re.findall(r"`make ([a-z0-9-]+)", text))
    assert len(named) > 20
    assert named <= make_targets(root)
    lanes = nox_sessions(root)
    assert len(lanes) > 40
    assert lanes - make_targets(root) == {"environment"}


def nox_sessions(root: Path) -> set[str]:
    script = "import json, noxfile, nox.registry; print(json.dumps(list(nox.registry.get())))"
    command = [sys.executable, "-c", script]
    told = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    return set(json.loads(told.stdout))


@pytest.mark.parametrize(
    "page",
    ["README.md", *sorted(p.name for p in (Path(__file__).parents[1] / "docs").glob("*.md"))],
)
def test_links_point_at_files_that_exist(root: Path, page: str) -> None:
    path = root / page if page == "README.md" else root / "docs" / page
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", path.read_text(encoding="utf-8")):
        assert (path.parent / target).exists(), f"{page} links to {target}, which is not there"
